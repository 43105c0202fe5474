"""The tabular Q-learning teacher, one per world, all of them stepped together."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_priors.envs.gridworld import GridMaps, transition
from torchrl_priors.random import uniform

__all__ = ["TeacherHyper", "Teachers", "evaluate_greedy", "q_step"]


class TeacherHyper(NamedTuple):
    """What all teachers share.

    Attributes:
        gamma: discount factor.
        lr: learning rate.
        epsilon: probability of a uniform action while learning.
        noise: probability that the environment replaces the action.
        end_prob: probability that a step ends the episode.
    """

    gamma: float
    lr: float
    epsilon: float
    noise: float
    end_prob: float


class Teachers(NamedTuple):
    """Teachers in training, one a world.

    Attributes:
        key: int64 ``[W]``, the random streams.
        start, position: int64 ``[W]``.
        q: float32 ``[W * C * 4]``, action values per state; changes in place.
        visited: bool ``[W * C]``, the states met; changes in place.
    """

    key: Tensor
    start: Tensor
    position: Tensor
    q: Tensor
    visited: Tensor


def _state(maps: GridMaps, position: Tensor, states: int) -> Tensor:
    """Row of the observation in tables of ``states`` rows a world, laid end to end like the positions."""
    return position - position % states + maps.state[position].long()


def _best(values: Tensor, draw: Tensor) -> Tensor:
    """Greedy action of ``values [4, N]``, ties broken by ``draw``."""
    ties = (values == values.max(0).values).long()
    rank = ties.cumsum(0) - 1
    chosen = (draw * ties.sum(0)).long()
    return ((rank == chosen).long() * ties * torch.arange(4, device=draw.device).unsqueeze(1)).sum(0)


def q_step(clock: Tensor, maps: GridMaps, teachers: Teachers, hyper: TeacherHyper) -> Tensor:
    """One epsilon-greedy transition in every world, and the Q-learning update for it.

    Args:
        clock (Tensor): int64 scalar, the number of this step.
        maps (GridMaps): the worlds.
        teachers (Teachers): ``q`` and ``visited`` change in place.
        hyper (TeacherHyper): what all teachers share.

    Returns:
        Tensor: the new positions.
    """
    states = teachers.visited.shape[0] // teachers.key.shape[0]
    four = torch.arange(4, device=clock.device).unsqueeze(1)
    tie, explore, slip, end = uniform(teachers.key, clock)
    here = _state(maps, teachers.position, states)
    values = teachers.q[here * 4 + four]
    # The part of the draw below epsilon is uniform too: it says which action to explore.
    random_action = (explore * (4 / max(hyper.epsilon, 1e-12))).long().clamp_max(3)
    action = torch.where(explore < hyper.epsilon, random_action, _best(values, tie))
    position, reward, done = transition(
        maps, teachers.position, action, slip, end, noise=hyper.noise, end_prob=hyper.end_prob
    )
    there = _state(maps, position, states)
    future = torch.where(done, 0.0, teachers.q[there * 4 + four].max(0).values)
    old = teachers.q[here * 4 + action]
    new = old + hyper.lr * (reward + hyper.gamma * future - old)
    teachers.q.index_put_((here * 4 + action,), new)
    teachers.visited.index_put_((here,), torch.ones_like(done))
    return torch.where(done, teachers.start, position)


@torch.no_grad()
def evaluate_greedy(
    maps: GridMaps, key: Tensor, start: Tensor, q: Tensor, hyper: TeacherHyper, *, episodes: int
) -> tuple[Tensor, Tensor]:
    """Mean undiscounted return and length of greedy episodes, noise and termination on.

    Args:
        maps (GridMaps): the worlds.
        key (Tensor): int64 ``[W]``.
        start (Tensor): int64 ``[W]``.
        q (Tensor): float32 ``[W * C * 4]``.
        hyper (TeacherHyper): for ``noise`` and ``end_prob``.

    Keyword Args:
        episodes (int): how many per world.

    Returns:
        two Tensors: float32 ``[W]``.
    """
    worlds = len(key)
    states = len(q) // (4 * worlds)
    four = torch.arange(4, device=key.device).unsqueeze(1)
    keys = torch.stack([key + episode for episode in range(episodes)], 1).flatten()
    position = start.repeat_interleave(episodes)
    alive = torch.ones_like(position, dtype=torch.bool)
    total, length = torch.zeros(worlds * episodes, device=key.device), torch.zeros(worlds * episodes, device=key.device)
    clock = 0
    while alive.any():
        tie, _, slip, end = uniform(keys, clock, 1)
        action = _best(q[_state(maps, position, states) * 4 + four], tie)
        position, reward, done = transition(
            maps, position, action, slip, end, noise=hyper.noise, end_prob=hyper.end_prob
        )
        total += torch.where(alive, reward, 0.0)
        length += alive
        alive &= ~done
        clock += 1
    return total.view(worlds, -1).mean(1), length.view(worlds, -1).mean(1)
