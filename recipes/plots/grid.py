"""A picture of a gridworld, with what an agent or a teacher does in it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch, Rectangle

from recipes.plots.style import COLUMN_WIDTH, new_figure, paper_style

__all__ = ["grid_world"]

_START, _WALL, _TERMINAL, _EMPTY, _DEGRADED, _LINES = "#4C84C4", "#111111", "#5FB56A", "#FFFFFF", "#C8102E", "#D4D4D4"
_INK = "#111111"
# not from white on: a weight of 0 is not a cell without a weight
_WEIGHT_MAP = ListedColormap(colormaps["Purples"](np.linspace(0.12, 1, 256)), "weights")

Colors = npt.NDArray[np.float64]


@paper_style
def grid_world(
    walls: Any,
    rewards: Any,
    terminal: Any,
    start: tuple[int, int],
    *,
    prior_weight: Any = None,
    degraded: Any = None,
    title: str | None = None,
    legend: bool | None = None,
    colorbar: bool = True,
    ax: Axes | None = None,
) -> Figure:
    """Draw a gridworld: start blue, walls black, terminal cells green, rewards as numbers; and overlays on it.

    Args:
        walls: bool, ``[H, W]``.
        rewards: reward on arrival, ``[H, W]``; 0 isn't printed.
        terminal: bool, ``[H, W]``.
        start: row and column of the first state.

    Keyword Args:
        prior_weight: weight in [0, 1] per cell, ``[H, W]``, drawn in shades of purple with a scale; NaN for none.
        degraded: bool, ``[H, W]``: cells where the prior is degraded, hatched and framed in red.
        title (str, optional): printed above.
        legend (bool, optional): whether to explain the colours below. By default, in a figure of its own only.
        colorbar (bool): whether to explain the shades of the weight, beside the map. Defaults to True.
        ax (Axes, optional): where to draw. A figure of one column's width is made by default.

    Returns:
        Figure: the figure drawn into.

    Raises:
        ValueError: the arrays aren't of one shape ``[H, W]``, the start is outside or in a wall, or a weight is no
            number in [0, 1].

    Examples:
        >>> walls, rewards = np.zeros((3, 3), bool), np.zeros((3, 3))
        >>> walls[0, 0], rewards[0, 2] = True, 10
        >>> figure = grid_world(walls, rewards, rewards > 1, (1, 1))
        >>> [text.get_text() for text in figure.axes[0].texts]
        ['10']
    """
    walls, terminal = _layer(walls, bool, "walls"), _layer(terminal, bool, "terminal")
    rewards = _layer(rewards, np.float64, "rewards")
    weight = None if prior_weight is None else _layer(prior_weight, np.float64, "prior_weight")
    degraded = np.zeros_like(walls) if degraded is None else _layer(degraded, bool, "degraded")
    row, column = (int(index) for index in start)
    _check(walls, (row, column), rewards=rewards, terminal=terminal, prior_weight=weight, degraded=degraded)
    height, width = walls.shape
    free = ~walls & ~terminal

    legend = ax is None if legend is None else legend
    if ax is None:
        extra = 0.2 * bool(title) + 0.22 * legend
        size = (COLUMN_WIDTH + 0.45 * (weight is not None), COLUMN_WIDTH * height / width + extra)
        ax = new_figure(*size).add_subplot()
    figure = ax.figure if isinstance(ax.figure, Figure) else ax.figure.figure

    colors = _cell_colors(walls, terminal, (row, column), weight)
    ax.imshow(colors, interpolation="nearest", extent=(0, width, height, 0))
    ax.hlines(np.arange(height + 1), 0, width, color=_LINES, linewidth=0.4, zorder=1.5)
    ax.vlines(np.arange(width + 1), 0, height, color=_LINES, linewidth=0.4, zorder=1.5)
    _set_frame(ax, walls.shape, title)
    if weight is not None and colorbar:
        add_weight_scale(figure, ax, shrink=0.7, aspect=22, pad=0.02)
    if legend:
        add_legend(figure, weight is not None, bool((degraded & free).any()))
    # the layout is settled: what is drawn into the cells is as large as they are
    cell = _cell_points(ax, walls.shape)
    if weight is not None:  # the start stays recognisable where its own weight is shown
        ax.add_patch(_outline(row, column, _START, cell))
    for r, c in np.argwhere(degraded & free):
        ax.add_patch(_outline(r, c, _DEGRADED, cell, hatch="////"))
    _draw_numbers(ax, np.where(walls, 0.0, rewards), colors, cell)
    return figure


def _check(walls: Any, start: tuple[int, int], **layers: Any) -> None:
    """Refuse what can't be drawn, before anything is."""
    for name, layer in layers.items():
        if layer is not None and layer.shape != walls.shape:
            raise ValueError(f"{name} has shape {layer.shape}, walls {walls.shape}.")
    row, column = start
    if not (0 <= row < walls.shape[0] and 0 <= column < walls.shape[1]) or walls[start]:
        raise ValueError(f"start {start} is outside the {walls.shape} grid or in a wall.")
    weight = layers["prior_weight"]
    if weight is not None and not (np.isnan(weight) | ((weight >= 0) & (weight <= 1))).all():
        raise ValueError("prior_weight holds values outside [0, 1].")


def _layer(values: Any, kind: Any, name: str) -> Any:
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    layer = np.asarray(values).astype(kind)
    if layer.ndim != 2 or layer.size == 0:
        raise ValueError(f"{name} needs the shape [H, W], got {layer.shape}.")
    return layer


def _cell_colors(walls: Any, terminal: Any, start: tuple[int, int], weight: Any) -> Colors:
    colors = np.empty((*walls.shape, 3))
    colors[...] = to_rgb(_EMPTY)
    colors[start] = to_rgb(_START)
    if weight is not None:
        known = ~np.isnan(weight)
        colors[known] = _WEIGHT_MAP(weight[known])[:, :3]
    colors[terminal] = to_rgb(_TERMINAL)
    colors[walls] = to_rgb(_WALL)
    return colors


def _ink(background: Colors) -> str:
    """Black on bright cells, white on dark ones (by luminance)."""
    return _INK if background @ np.array([0.299, 0.587, 0.114]) > 0.5 else "white"


def _cell_points(ax: Axes, shape: tuple[int, int]) -> float:
    """How many points wide a cell is printed."""
    ax.figure.draw_without_rendering()  # type: ignore[union-attr]  # settles the layout
    box = ax.get_window_extent()
    return 72 / ax.figure.dpi * min(box.width / shape[1], box.height / shape[0])


def _outline(row: int, column: int, color: str, cell: float, hatch: str | None = None) -> Rectangle:
    inset = 0.06
    return Rectangle(
        (column + inset, row + inset),
        1 - 2 * inset,
        1 - 2 * inset,
        fill=False,
        edgecolor=color,
        hatch=hatch,
        linewidth=min(1.4, 0.12 * cell),
        zorder=2,
    )


def _draw_numbers(ax: Axes, rewards: Any, colors: Colors, cell: float) -> None:
    """Rewards other than 0, all in the size at which the longest fits its cell."""
    texts = {(r, c): f"{rewards[r, c]:.3g}".replace("-", "\N{MINUS SIGN}") for r, c in np.argwhere(rewards != 0)}
    size = min([8.0, 0.55 * cell, *(1.4 * cell / len(text) for text in texts.values())])
    for (r, c), text in texts.items():
        ink = _ink(colors[r, c])
        ax.text(c + 0.5, r + 0.52, text, ha="center", va="center_baseline", fontsize=size, color=ink, zorder=4)


def _set_frame(ax: Axes, shape: tuple[int, int], title: str | None) -> None:
    ax.set(xlim=(0, shape[1]), ylim=(shape[0], 0), xticks=[], yticks=[], aspect="equal")
    ax.grid(visible=False)
    for spine in ax.spines.values():
        spine.set(visible=True, color=_WALL, linewidth=0.8)
    if title:
        ax.set_title(title)


def add_weight_scale(figure: Figure, where: Any, **options: Any) -> None:
    """The shades of the weight, as a colour bar beside one or more axes."""
    bar = figure.colorbar(ScalarMappable(Normalize(0, 1), _WEIGHT_MAP), ax=where, **options)
    bar.set_label(r"Prior weight $\omega$")
    bar.outline.set_linewidth(0.5)


def add_legend(figure: Figure | SubFigure, weighted: bool, degraded: bool) -> None:
    """What the colours of the cells mean, below the figure."""
    outline: dict[str, Any] = {"linewidth": 0.6, "edgecolor": "0.4"}
    start = Patch(fill=False, edgecolor=_START, linewidth=1.2) if weighted else Patch(facecolor=_START, **outline)
    handles = [(start, "Start"), (Patch(facecolor=_WALL, **outline), "Wall")]
    handles.append((Patch(facecolor=_TERMINAL, **outline), "Terminal"))
    if degraded:
        handles.append((Patch(fill=False, edgecolor=_DEGRADED, hatch="////", linewidth=1.0), "Degraded"))
    figure.legend(
        [handle for handle, _ in handles],
        [label for _, label in handles],
        loc="outside lower center",
        ncols=len(handles),
        fontsize=7.5,
        columnspacing=1.2,
        handlelength=1.1,
        handleheight=1.1,
        handletextpad=0.5,
    )
