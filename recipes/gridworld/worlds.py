"""Random grid worlds (Czarnecki et al., "Distilling Policy Distillation", 2019, A.2), a batch of them at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorClass
from torch import Tensor
from torch.nn import functional as F

__all__ = ["KINDS", "MOVES", "GridWorlds", "sample_worlds"]

#: Row and column change of the four actions: up, right, down, left.
MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
#: Reward on arriving at a cell of each kind; kind 0 is empty, kind 1 a wall. This is also the order of the draws.
KINDS = (0.0, 0.0, 10.0, -10.0, 5.0, -5.0, 1.0, -1.0)
_WALL = 1


class GridWorlds(TensorClass["nocast"]):  # type: ignore[name-defined]
    """A batch of ``W`` worlds of ``C = size * size`` cells (numbered row by row), as look-up tables.

    Attributes:
        kind: int64 ``[W, C]``, what lies on each cell, an index into :data:`KINDS`.
        next_cell: int64 ``[W, C, 4]``, where each action leads; into a wall or off the grid is no move.
        reward: float32 ``[W, C]``, paid on every arrival at the cell.
        terminal: bool ``[W, C]``, whether arriving ends the episode.
        state: int64 ``[W, C]``, the number of the observation: cells that look alike share that of the first of them.
        start: int64 ``[W]``, the cell where episodes begin.
        window: side of the square that the agent sees.
    """

    kind: Tensor
    next_cell: Tensor
    reward: Tensor
    terminal: Tensor
    state: Tensor
    start: Tensor
    window: int

    @property
    def num_cells(self) -> int:
        """Cells of a world, which is also the number of rows a per-state table needs."""
        return self.kind.shape[-1]

    @property
    def size(self) -> int:
        """Cells along a side."""
        return round(self.num_cells**0.5)

    def reachable(self) -> Tensor:
        """Bool ``[W, C]``: cells that some sequence of actions reaches from the start (terminal cells are not left)."""
        reached = F.one_hot(self.start, self.num_cells).bool()
        while True:
            origin = (reached & ~self.terminal).unsqueeze(-1).expand_as(self.next_cell)
            counts = torch.zeros_like(self.kind).scatter_add_(-1, self.next_cell.flatten(-2), origin.long().flatten(-2))
            grown = reached | (counts > 0)
            if torch.equal(grown, reached):
                return reached
            reached = grown

    def has_goal(self) -> Tensor:
        """Bool ``[W]``: whether a positive terminal reward can be reached from the start."""
        return (self.reachable() & self.terminal & (self.reward > 0)).any(-1)

    def layers(self, index: int = 0) -> dict[str, Any]:
        """Walls, rewards, terminal cells and start of a world, as :func:`recipes.plots.grid_world` takes them.

        Examples:
            >>> from recipes.plots import grid_world
            >>> worlds = sample_worlds(torch.arange(2), size=7, window=3)
            >>> grid_world(**worlds.layers(1)).axes[0].get_ylim() == (7, 0)
            True
        """
        world, shape = self[index].cpu(), (self.size, self.size)
        cells = {"walls": world.kind == _WALL, "rewards": world.reward, "terminal": world.terminal}
        squares = {name: values.view(shape).numpy() for name, values in cells.items()}
        return {**squares, "start": divmod(int(world.start), self.size)}

    @classmethod
    def from_kinds(cls, kind: Tensor, start: Tensor, window: int) -> GridWorlds:
        """The worlds that a map of cell kinds describes.

        Args:
            kind (Tensor): int64 ``[W, size, size]``.
            start (Tensor): int64 ``[W]``.
            window (int): side of the square that the agent sees, odd.
        """
        worlds, size = kind.shape[0], kind.shape[-1]
        wall = kind == _WALL
        cells = torch.arange(size * size, device=kind.device)
        row, col = cells // size, cells % size
        targets = []
        for down, right in MOVES:
            to_row, to_col = row + down, col + right
            inside = (to_row >= 0) & (to_row < size) & (to_col >= 0) & (to_col < size)
            target = torch.where(inside, to_row * size + to_col, cells)
            targets.append(torch.where(wall.flatten(1)[:, target], cells, target))
        flat = kind.flatten(1)
        reward = torch.tensor(KINDS, device=kind.device)[flat]
        return cls(
            kind=flat,
            next_cell=torch.stack(targets, -1),
            reward=reward,
            terminal=reward.abs() >= 5,
            state=_first_alike(windows(flat, window)),
            start=start,
            window=window,
            batch_size=[worlds],
        )


def windows(kind: Tensor, window: int) -> Tensor:
    """What the agent sees from each cell: kinds in a square around it, walls beyond the border.

    Args:
        kind (Tensor): int64 ``[W, C]``.
        window (int): side of the square, odd.

    Returns:
        Tensor: uint8 ``[W, C, window, window]``.
    """
    size, reach = round(kind.shape[-1] ** 0.5), window // 2
    padded = F.pad(kind.view(-1, size, size).to(torch.uint8), (reach,) * 4, value=_WALL)
    return padded.unfold(1, window, 1).unfold(2, window, 1).flatten(1, 2)


def _first_alike(views: Tensor) -> Tensor:
    """For each cell, the first cell of its world with the same view: uint8 ``[W, C, ...]`` to int64 ``[W, C]``."""
    rows = np.ascontiguousarray(views.flatten(2).cpu().numpy())
    first = []
    for view in rows.view(f"V{rows.shape[-1]}")[..., 0]:  # each row as one value
        _, index, group = np.unique(view, return_index=True, return_inverse=True)
        first.append(index[group])
    return torch.from_numpy(np.stack(first)).to(views.device)


def sample_worlds(
    seeds: Tensor, *, size: int = 20, window: int = 9, wall_prob: float = 0.2, object_prob: float = 0.01
) -> GridWorlds:
    """Sample one world per seed.

    Each cell is a wall with probability ``wall_prob``; else the objects +10, -10, +5, -5, +1 and -1 are tried in this
    order, each with probability ``object_prob``; else it stays empty. The start, in the middle, is always empty.

    Args:
        seeds (Tensor): int64 ``[W]``; a world depends on its own seed alone.

    Keyword Args:
        size (int): cells along a side.
        window (int): side of the square that the agent sees, odd.
        wall_prob (float): probability of a wall.
        object_prob (float): probability of each kind of object, given that none before it was placed.

    Raises:
        ValueError: no seeds, an even window, or probabilities outside [0, 1].

    Examples:
        >>> worlds = sample_worlds(torch.arange(2))
        >>> worlds.kind.shape, worlds.start.tolist()
        (torch.Size([2, 400]), [210, 210])
    """
    if seeds.ndim != 1 or len(seeds) == 0:
        raise ValueError(f"seeds must be a non-empty vector, got shape {tuple(seeds.shape)}.")
    if size < 1 or window < 1 or window % 2 == 0:
        raise ValueError(f"size must be positive and window odd, got size={size}, window={window}.")
    for name, prob in (("wall_prob", wall_prob), ("object_prob", object_prob)):
        if not 0 <= prob <= 1:
            raise ValueError(f"{name} must be a probability, got {prob}.")
    draws = [np.random.default_rng(seed % 2**64).random(size * size) for seed in seeds.tolist()]
    draw = torch.from_numpy(np.stack(draws)).to(seeds.device)
    # One draw against the cumulated probabilities does what the sequence of Bernoulli draws does.
    bounds, left = [], 1.0
    for prob in (wall_prob, *[object_prob] * (len(KINDS) - 2)):
        left *= 1 - prob
        bounds.append(1 - left)
    kind = torch.bucketize(draw, torch.tensor(bounds, dtype=draw.dtype, device=seeds.device), right=True) + 1
    kind = torch.where(kind == len(KINDS), 0, kind)
    middle = size // 2 * size + size // 2
    kind[:, middle] = 0
    return GridWorlds.from_kinds(kind.view(-1, size, size), torch.full_like(seeds, middle), window)
