"""The tables of a single run while it learns: what its prior weights are, state by state."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_priors.envs.gridworld import GridMaps
from torchrl_priors.envs.worlds import GridWorlds
from torchrl_priors.tabular import actor_critic as ac
from torchrl_priors.tabular.advice import advice_tables
from torchrl_priors.tabular.study import _LANES, StudentConfig, _compiled, _pad, build_runs

__all__ = ["WeightHistory", "weight_history"]


class WeightHistory(NamedTuple):
    """The prior weights of a run at each of its evaluation episodes.

    Attributes:
        weight: float32 ``[points, C]``, by state.
        visits: int64 ``[points, C]``, how often each state was trained on by then.
    """

    weight: Tensor
    visits: Tensor

    def mean_over(self, states: Tensor) -> Tensor:
        """Mean weight over those of some states (bool ``[C]``) that were visited by then, ``[points]``; NaN if none."""
        seen = (self.visits > 0) & states
        return torch.where(seen, self.weight, 0.0).sum(-1) / seen.sum(-1)


@torch.no_grad()
def weight_history(
    world: GridWorlds,
    seed: int,
    q: Tensor,
    degraded: dict[int, Tensor],
    pair: tuple[str, str],
    config: StudentConfig,
    *,
    compile: bool = False,
    progress: Callable[[int], object] = lambda n: None,
) -> WeightHistory:
    """Train one student once more, and watch its prior weights.

    It is the very run of :func:`~torchrl_priors.tabular.train_students` with this seed, method and prior.

    Args:
        world (GridWorlds): one world.
        seed (int): of the world's runs.
        q (Tensor): the teacher's action values, ``[1, C, 4]``.
        degraded (dict): bool masks ``[1, C]`` by number of states.
        pair (tuple of str): method and prior.
        config (StudentConfig): how it learns.

    Keyword Args:
        compile (bool): whether to compile the step.
        progress (callable): called with 1 at each evaluation.

    Returns:
        WeightHistory: its weights.

    Raises:
        ValueError: more than one world.
    """
    if len(world) != 1:
        raise ValueError(f"A history is of one world, got {len(world)}.")
    device = world.kind.device
    maps = GridMaps.from_worlds(world)
    advice = advice_tables(q, degraded, config.temperature)
    one = build_runs(world, torch.tensor([seed], device=device), [pair], degraded, config)
    runs = ac.Runs(*(_pad(value, _LANES) for value in one))  # copies, for a compiled step serves whole vectors
    records, log = ac.new_records(_LANES, world.num_cells, device), ac.new_log(_LANES, config.hyper.eval_points, device)
    carry = ac.initial_carry(maps, advice, runs, config.hyper)
    step = _compiled(ac.advance, compile)
    clock = torch.zeros(_LANES, dtype=torch.int64, device=device)
    visits = torch.zeros(world.num_cells, dtype=torch.int64, device=device)
    weights, visited, points = [], [], 0
    while points < config.hyper.eval_points:
        state, training = int(maps.state[carry.position[0]]), not bool(carry.evaluating[0])
        visits[state] += training
        carry = step(clock, maps, advice, runs, carry, records, log, config.hyper)
        clock = clock + 1
        if int(carry.points[0]) > points:
            points += 1
            table = records[: world.num_cells * ac.RECORD_WIDTH].view(-1, ac.RECORD_WIDTH)
            # between episodes: what is pending has its effect at the next visit
            weights.append((table[:, ac._WEIGHT] + table[:, ac._WEIGHT_PENDING]).sigmoid())
            visited.append(visits.clone())
            progress(1)
    return WeightHistory(torch.stack(weights), torch.stack(visited))
