"""A batch of grid worlds as one TorchRL environment."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from recipes.gridworld.worlds import KINDS, GridWorlds, windows

__all__ = ["GridMaps", "GridWorldEnv", "transition"]


class GridMaps(NamedTuple):
    """The look-up tables of ``W`` worlds laid end to end; a *position* is ``world * C + cell``.

    Attributes:
        next_position: int32 ``[W * C * 4]``.
        reward: float32 ``[W * C]``.
        terminal: bool ``[W * C]``.
        state: int32 ``[W * C]``, the number of the observation within its world.
    """

    next_position: Tensor
    reward: Tensor
    terminal: Tensor
    state: Tensor

    @classmethod
    def from_worlds(cls, worlds: GridWorlds) -> GridMaps:
        """Lay the tables of a batch of worlds end to end."""
        offset = torch.arange(len(worlds), device=worlds.kind.device).view(-1, 1, 1) * worlds.num_cells
        return cls(
            next_position=(worlds.next_cell + offset).flatten().int(),
            reward=worlds.reward.flatten(),
            terminal=worlds.terminal.flatten(),
            state=worlds.state.flatten().int(),
        )


def transition(
    maps: GridMaps, position: Tensor, action: Tensor, slip: Tensor, end: Tensor, *, noise: float, end_prob: float
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of any number of agents, as a pure function of the uniform draws that decide it.

    Args:
        maps (GridMaps): the worlds.
        position (Tensor): int64 ``[*B]``, where the agents are.
        action (Tensor): int64 ``[*B]``, in ``[0, 4)``: up, right, down, left.
        slip (Tensor): ``[*B]`` in [0, 1); below ``noise`` a uniform action replaces the agent's (the same draw chooses
            it).
        end (Tensor): ``[*B]`` in [0, 1); below ``end_prob`` the episode ends.

    Keyword Args:
        noise (float): probability that the action is replaced.
        end_prob (float): probability that a step ends the episode.

    Returns:
        three Tensors ``[*B]``: the next position (int64), the reward of arriving there, and whether the episode
        terminated.
    """
    if noise > 0:
        replacement = (slip * (4 / noise)).long().clamp_max(3)
        action = torch.where(slip < noise, replacement, action)
    following = maps.next_position[position * 4 + action].long()
    return following, maps.reward[following], maps.terminal[following] | (end < end_prob)


class GridWorldEnv(EnvBase):
    """Grid worlds of Czarnecki et al. (2019), ``W`` of them stepped as one batch.

    An agent in the middle of a grid sees the window around it and moves up, right, down or left. Arriving at a cell
    pays its reward; +-5 and +-10 are terminal, +-1 are not. With probability ``noise`` a uniform action replaces the
    agent's, and each step ends the episode with probability ``end_prob``.

    Keys: ``observation`` uint8 ``[W, window, window]`` (kinds of cells, see ``worlds.KINDS``),
    ``state`` int64 ``[W]`` (the number of the observation, for tables of ``C`` rows), ``position`` int64 ``[W]``,
    ``action`` int64 ``[W]``, ``reward`` float32 ``[W, 1]``. Random numbers come from a CPU generator of its own, so
    that a seed gives the same rollout on every device; the generator's state is part of the ``state_dict``.

    Args:
        worlds (GridWorlds): from :func:`sample_worlds`.

    Keyword Args:
        noise (float): probability that the action is replaced.
        end_prob (float): probability that a step ends the episode.
        seed (int, optional): as in :meth:`set_seed`.
        device (device, optional): defaults to that of ``worlds``.

    Raises:
        ValueError: probabilities outside [0, 1].

    Examples:
        >>> from recipes.gridworld.worlds import sample_worlds
        >>> env = GridWorldEnv(sample_worlds(torch.arange(3)), seed=0)
        >>> rollout = env.rollout(5, break_when_any_done=False)
        >>> rollout.shape, rollout["observation"].shape
        (torch.Size([3, 5]), torch.Size([3, 5, 9, 9]))
    """

    batch_locked = True
    start: Tensor
    view: Tensor
    next_position: Tensor
    reward: Tensor
    terminal: Tensor
    state: Tensor

    def __init__(
        self,
        worlds: GridWorlds,
        *,
        noise: float = 0.1,
        end_prob: float = 0.01,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        for name, prob in (("noise", noise), ("end_prob", end_prob)):
            if not 0 <= prob <= 1:
                raise ValueError(f"{name} must be a probability, got {prob}.")
        device = torch.device(device) if device is not None else worlds.kind.device
        count = len(worlds)
        super().__init__(device=device, batch_size=[count])
        self.worlds = worlds.to(device)
        self.noise, self.end_prob = noise, end_prob
        for name, table in GridMaps.from_worlds(self.worlds)._asdict().items():
            self.register_buffer(name, table)
        self.register_buffer("view", windows(self.worlds.kind, worlds.window).flatten(0, 1))
        offset = torch.arange(count, device=device) * self.worlds.num_cells
        self.register_buffer("start", self.worlds.start + offset)
        self.generator = torch.Generator()
        cells = self.worlds.num_cells
        self.observation_spec = Composite(
            observation=Bounded(0, len(KINDS) - 1, (count, worlds.window, worlds.window), device, torch.uint8),
            state=Categorical(cells, (count,), device, torch.int64),
            position=Categorical(count * cells, (count,), device, torch.int64),
            shape=(count,),
            device=device,
        )
        self.action_spec = Categorical(4, (count,), device, torch.int64)
        self.reward_spec = Unbounded((count, 1), device)
        self.set_seed(seed)

    @property
    def maps(self) -> GridMaps:
        """The look-up tables that :func:`transition` takes."""
        return GridMaps(self.next_position, self.reward, self.terminal, self.state)

    def _observe(self, position: Tensor) -> dict[str, Tensor]:
        return {"observation": self.view[position], "state": self.state[position].long(), "position": position}

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {**self._observe(self.start.clone()), "done": done, "terminated": done.clone()},
            self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        if not torch.compiler.is_compiling() and not ((action >= 0) & (action < 4)).all():
            low, high = int(action.min()), int(action.max())
            raise ValueError(f"Actions are 0 to 3 (up, right, down, left), got {low} to {high}.")
        slip, end = torch.rand(2, *self.batch_size, generator=self.generator).to(self.device)
        position, reward, terminated = transition(
            self.maps, tensordict["position"], action, slip, end, noise=self.noise, end_prob=self.end_prob
        )
        terminated = terminated.unsqueeze(-1)
        return TensorDict(
            {
                **self._observe(position),
                "reward": reward.unsqueeze(-1),
                "done": terminated.clone(),
                "terminated": terminated,
            },
            self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(torch.empty((), dtype=torch.int64).random_())
        self.generator.manual_seed(seed)

    def get_extra_state(self) -> Tensor:
        """The state of the random numbers."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restores it."""
        self.generator.set_state(state.cpu())
