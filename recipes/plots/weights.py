"""What a prior weight does: over a gridworld, over training, and along an episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from recipes.plots.grid import add_legend, add_weight_scale, grid_world
from recipes.plots.style import (
    TEXT_WIDTH,
    line_style,
    method_color,
    method_label,
    new_figure,
    outer_labels,
    paper_style,
    prior_label,
    thousands,
)

__all__ = ["episode_weights", "weight_curves", "weight_maps"]

_DEGRADED, _OTHER = "#C8102E", "#3F007D"  # the frames of degraded cells, and the darkest shade of a weight
_DASHED = (0, (2.2, 1.2))


@paper_style
def weight_maps(
    world: Mapping[str, Any],
    weights: Mapping[str, Any],
    degraded: Any,
    *,
    steps: Any,
    over_degraded: Any,
    over_other: Any,
) -> Figure:
    """Maps of the prior weight at some moments of training, and its mean over the degraded and the other states.

    Args:
        world: ``walls``, ``rewards``, ``terminal`` and ``start``, as :func:`grid_world` takes them.
        weights: by title, the weight per cell ``[H, W]``; NaN where there is none.
        degraded: bool ``[H, W]``: cells where the prior is degraded.

    Keyword Args:
        steps: when the means were taken, ``[N]``.
        over_degraded, over_other: the mean weights then, ``[N]``; NaN where there is none.

    Returns:
        Figure: as wide as a page.

    Raises:
        ValueError: no map, or means of another length than ``steps``; else as :func:`grid_world`.

    Examples:
        >>> grid = np.zeros((2, 2))
        >>> world = {"walls": grid, "rewards": grid, "terminal": grid, "start": (0, 0)}
        >>> means = {"steps": [0, 10], "over_degraded": [0.5, 0.2], "over_other": [0.5, 0.6]}
        >>> len(weight_maps(world, {"End": grid + 0.5}, grid, **means).axes)  # a map, a curve and the scale
        3
    """
    steps, low, high = (np.asarray(values, np.float64) for values in (steps, over_degraded, over_other))
    if not weights:
        raise ValueError("weight_maps needs at least one map.")
    if not steps.ndim == 1 or not steps.shape == low.shape == high.shape:
        raise ValueError(f"steps and the means need one shape [N], got {steps.shape}, {low.shape} and {high.shape}.")
    count = len(weights)
    figure = new_figure(TEXT_WIDTH, 2.65 if count < 3 else 2.15)
    *maps, curve = figure.subplots(1, count + 1, width_ratios=[1.0] * count + [0.78])
    add_weight_scale(figure, maps, shrink=0.8, aspect=24, pad=0.015)
    curve.plot(steps, high, color=_OTHER, label="Other states")
    if not np.isnan(low).all():
        curve.plot(steps, low, color=_DEGRADED, linestyle=_DASHED, label="Degraded states")
    curve.set(ylim=(0, 1), xlim=(0, steps.max()), xlabel="Transitions", ylabel=r"Mean prior weight $\omega$")
    curve.set_box_aspect(1.0)
    curve.xaxis.set_major_locator(MaxNLocator(3))
    curve.xaxis.set_major_formatter(FuncFormatter(thousands))
    curve.legend(loc="best", fontsize=7.5, handlelength=1.8)
    add_legend(figure, weighted=True, degraded=bool(np.asarray(degraded).any()))
    for ax, (title, weight) in zip(maps, weights.items(), strict=True):
        grid_world(**world, prior_weight=weight, degraded=degraded, title=title, colorbar=False, legend=False, ax=ax)
    return figure


@paper_style
def weight_curves(curves: Mapping[str, Mapping[str, tuple[Any, Any]]], steps: Any) -> Figure:
    """Mean prior weight over training, at degraded states (dashed) and at the others, a panel per prior.

    Args:
        curves: by prior and method, the means at degraded states and at the others, ``[N]`` each.
        steps: when they were taken, ``[N]``.

    Returns:
        Figure: as wide as a page.

    Raises:
        ValueError: nothing to draw, or another length than ``steps``.

    Examples:
        >>> figure = weight_curves({"structural_3": {"ae2r": ([0.5, 0.3], [0.5, 0.4])}}, [0, 10])
        >>> [ax.get_title() for ax in figure.axes]
        ['Structural, 3 states']
    """
    steps = np.asarray(steps, np.float64)
    if not any(curves.values()):
        raise ValueError("weight_curves needs at least one curve.")
    columns = min(len(curves), 4)
    rows = -(-len(curves) // columns)
    figure = new_figure(TEXT_WIDTH, 0.35 + 1.65 * rows)
    grid = figure.add_gridspec(rows, columns)
    axes: dict[tuple[int, int], Axes] = {}
    for number, (prior, by_method) in enumerate(curves.items()):
        ax = axes[divmod(number, columns)] = figure.add_subplot(grid[divmod(number, columns)])
        for method, means in by_method.items():
            for values, style in zip(means, (_DASHED, "-"), strict=True):
                values = np.asarray(values, np.float64)
                if values.shape != steps.shape:
                    raise ValueError(f"{prior}, {method}: {values.shape} values at {steps.shape} steps.")
                ax.plot(steps, values, **{**line_style(method), "linestyle": style})
        ax.set(title=prior_label(prior), ylim=(0, 1), xlim=(0, steps.max()))
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.xaxis.set_major_formatter(FuncFormatter(thousands))
    outer_labels(axes, "Transitions", r"Prior weight $\omega$", share_y=True)
    methods = list(dict.fromkeys(method for by_method in curves.values() for method in by_method))
    kinds = [
        Line2D([], [], color="0.3", label="Other states"),
        Line2D([], [], color="0.3", linestyle=_DASHED, label="Degraded states"),
    ]
    lines = [Line2D([], [], label=method_label(method), **line_style(method)) for method in methods]
    handles = [*lines, *kinds]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), columnspacing=1.4, handlelength=1.8)
    return figure


@paper_style
def episode_weights(weight: Any, log_prob: Any, td_error: Any, *, method: str, degraded: Any = None) -> Figure:
    r"""The prior weight along an episode, above what it is learned from; steps with degraded advice are shaded.

    Args:
        weight: :math:`\omega(s_t)`, ``[T]``.
        log_prob: :math:`\log\pi_0(a_t|s_t)`, ``[T]``.
        td_error: on raw rewards, ``[T]``.

    Keyword Args:
        method (str): whose weight it is.
        degraded: bool ``[T]``, where the advice is degraded. None by default.

    Returns:
        Figure: as wide as a page, three panels with one axis of steps.

    Raises:
        ValueError: the values are not of one length.

    Examples:
        >>> figure = episode_weights([0.5, 0.4], [-1.0, -2.0], [0.1, 0.0], method="ae2r", degraded=[False, True])
        >>> len(figure.axes)
        3
    """
    rows = [np.asarray(values, np.float64) for values in (weight, log_prob, td_error)]
    bad = np.zeros(len(rows[0]), bool) if degraded is None else np.asarray(degraded, bool)
    if any(row.shape != bad.shape or row.ndim != 1 for row in rows) or not len(bad):
        raise ValueError(f"Expected values of one shape [T], got {[row.shape for row in rows]} and {bad.shape}.")
    figure = new_figure(TEXT_WIDTH, 3.5)
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[1.25, 1, 1])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    labels = (r"$\omega(s_t)$", r"$\log\,\pi_0(a_t|s_t)$", "TD error")
    for ax, row, label, color in zip(axes, rows, labels, (method_color(method), "0.15", "0.15"), strict=True):
        for start, stop in edges.reshape(-1, 2):
            ax.axvspan(start - 0.5, stop - 0.5, color=_DEGRADED, alpha=0.13, linewidth=0, zorder=0.5)
        ax.plot(row, color=color, linewidth=1.1 if ax is axes[0] else 0.7)
        ax.set_ylabel(label)
        ax.margins(x=0)
    axes[0].set_ylim(0, 1)
    axes[2].axhline(0, color="0.6", linewidth=0.5, zorder=1)
    axes[2].set_xlabel("Step of the episode")
    figure.align_ylabels(axes)
    handles: list[Any] = [Line2D([], [], color=method_color(method), label=f"Prior weight of {method_label(method)}")]
    if degraded is not None:
        handles.append(Patch(facecolor=_DEGRADED, alpha=0.13, label="Degraded advice"))
    if bad.any() and not bad.all():
        means = f"mean {rows[0][bad].mean():.2f} there, {rows[0][~bad].mean():.2f} elsewhere"
        handles.append(Line2D([], [], linestyle="none", label=means))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), handlelength=1.6)
    return figure
