"""Panels of methods and their variants, for each environment, teacher or prior: curves, profiles and intervals.

A method may come with settings, as in ``"ae2r Cω=0.03"``: see :mod:`recipes.plots.variants`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from recipes.metrics import MIN_RUNS, ConfidenceInterval, performance_profile
from recipes.plots.style import (
    COLUMN_WIDTH,
    TEXT_WIDTH,
    new_figure,
    outer_labels,
    paper_style,
    thousands,
)
from recipes.plots.variants import variant_label, variant_styles

__all__ = ["curve_panels", "interval_panels", "profile_panels"]

Places: TypeAlias = Mapping[str, tuple[int, int]]

_INK = "#222222"
_REFERENCE: dict[str, Any] = {"color": "0.45", "linewidth": 0.8, "linestyle": (0, (1, 1.5))}
_MARKER: dict[str, Any] = {
    "marker": "D",
    "markersize": 3.6,
    "color": _INK,
    "markerfacecolor": "white",
    "markeredgewidth": 0.8,
    "linestyle": "none",
    "zorder": 5,
}


@paper_style
def curve_panels(
    panels: Mapping[str, Mapping[str, ConfidenceInterval]],
    steps: Mapping[str, Any],
    *,
    columns: int | None = None,
    places: Places | None = None,
    share_y: bool = False,
    xlabel: str = "Frames",
    ylabel: str = "Return",
    baseline: str | None = None,
    references: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """Curves with bands, a panel per environment (and prior).

    Args:
        panels: by title and method, a curve with its interval, arrays ``[points]``; a NaN interval is not drawn.
        steps: by title, where the points are, ``[points]``; or by title and method, where curves have their own.

    Keyword Args:
        columns (int, optional): panels in a row. Defaults to as many as there are, at most 3.
        places (mapping, optional): row and column of each title, in the place of ``columns``.
        share_y (bool): whether all panels have one scale, as those of one environment should. Defaults to ``False``.
        xlabel, ylabel (str): names of the axes.
        baseline (str, optional): what method ``none`` is called. Defaults to its usual name.
        references: by title and name, a level to mark by a thin grey line, e.g. the teacher's return.

    Returns:
        Figure: as wide as two columns, or one for a single panel.

    Raises:
        ValueError: there are no curves, or a curve doesn't have the points of its steps; the message names it.

    Examples:
        >>> band = ConfidenceInterval(np.arange(3.0), np.arange(3.0) - 1, np.arange(3.0) + 1)
        >>> len(curve_panels({"Hopper": {"ae2r Cω=1": band}}, {"Hopper": [0, 50, 100]}).axes)
        1
    """
    names = _names(panels)
    figure, axes = _panels(panels, columns, places, row_height=1.75, share_y=share_y)
    styles = variant_styles(names)
    for (title, curves), ax in zip(panels.items(), axes.values(), strict=True):
        for name, curve in curves.items():
            where = steps[title]
            x = np.asarray(where[name] if isinstance(where, Mapping) else where, dtype=np.float64)
            _draw_band(ax, x, curve, styles[name], f"curve {name!r} of {title!r}")
        for level in (references or {}).get(title, {}).values():
            ax.axhline(level, **_REFERENCE, zorder=1.8)
        ax.set_title(title, linespacing=1.05)
        ax.margins(x=0)
        ax.xaxis.set_major_formatter(FuncFormatter(thousands))
        ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    outer_labels(axes, xlabel, ylabel, share_y)
    marked = dict.fromkeys(name for levels in (references or {}).values() for name in levels)
    _legend(figure, styles, baseline, [Line2D([], [], label=name, **_REFERENCE) for name in marked])
    return figure


@paper_style
def profile_panels(
    panels: Mapping[str, Mapping[str, Any]],
    thresholds: Any = None,
    *,
    confidence: float = 0.95,
    reps: int = 2000,
    seed: int = 0,
) -> Figure:
    r"""Performance profiles, a panel per prior: the share of runs whose area ratio exceeds a threshold.

    The dashed line marks 0, no improvement over the baseline. A method with fewer than four runs has no band.

    Args:
        panels: by title and method, area ratios ``[runs]`` or ``[runs, tasks]``, or with ``thresholds`` a profile.
        thresholds: ``[points]``, ascending. By default from -1 to what one run in fifty exceeds, at least 1
            and at most 10.

    Keyword Args:
        confidence (float): of the stratified bootstrap bands. Defaults to 0.95.
        reps (int): resamples. Defaults to 2000.
        seed (int): of the resampling. Defaults to 0.

    Returns:
        Figure: as wide as two columns, or one for a single panel.

    Raises:
        ValueError: there are no profiles.

    Examples:
        >>> ratios = np.random.default_rng(0).normal(scale=0.3, size=(5, 2))
        >>> len(profile_panels({"good": {"e2r": ratios}, "bad": {"e2r": ratios - 0.2}}).axes)
        2
    """
    styles = variant_styles(_names(panels))
    figure, axes = _panels(panels, None, None, row_height=1.75)
    if thresholds is None:
        every = np.concatenate([np.ravel(scores) for profiles in panels.values() for scores in profiles.values()])
        thresholds = np.linspace(-1, min(10.0, max(1.0, np.ceil(4 * np.quantile(every, 0.98)) / 4)), 401)
    taus = np.asarray(thresholds, dtype=np.float64)
    for (title, profiles), ax in zip(panels.items(), axes.values(), strict=True):
        ax.axvline(0, color="0.35", linestyle=(0, (3, 2)), linewidth=0.9, zorder=1.5)
        for name, scores in profiles.items():
            if isinstance(scores, ConfidenceInterval):
                band = scores
            else:
                band = performance_profile(scores, taus, confidence=confidence, reps=reps, seed=seed)
                if len(scores) < MIN_RUNS:
                    band = band._replace(low=band.estimate, high=band.estimate)
            _draw_band(ax, taus, band, styles[name], f"profile of {name!r}")
        ax.set_title(title, linespacing=1.05)
        ax.set(xlim=(taus.min(), taus.max()), ylim=(0, 1))
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        ax.xaxis.set_major_locator(MaxNLocator(5))
    outer_labels(axes, r"Area ratio $\tau$", r"Runs with $r_{\pi_0} > \tau$", share_y=True)
    _legend(figure, styles, None)
    return figure


@paper_style
def interval_panels(
    panels: Mapping[str, Mapping[str, ConfidenceInterval]],
    *,
    center: float = 0.0,
    columns: int | None = None,
    places: Places | None = None,
    scale: float = 1.0,
    reference: Mapping[str, Mapping[str, ConfidenceInterval]] | None = None,
    xlabel: str = r"IQM of $r_{\pi_0}$",
    xlim: tuple[float, float] | None = None,
    baseline: str | None = None,
) -> Figure:
    """Estimates as lines and their intervals as bars, a row per method and a panel per environment (and prior).

    Args:
        panels: by title and method, an estimate with its interval, floats; a NaN interval is not drawn.

    Keyword Args:
        center (float): the dashed line: 0 for a ratio, ½ for a probability. Defaults to 0.
        columns (int, optional): panels in a row. Defaults to as many as there are, at most 3.
        places (mapping, optional): row and column of each title, in the place of ``columns``.
        scale (float): what values are multiplied with before they are drawn. Defaults to 1.
        reference (mapping, optional): the paper's values, by title and method; their ends are whiskers.
        xlabel (str): name of the axis.
        xlim (tuple of float, optional): one scale for all panels; else each has its own, which holds the centre.
        baseline (str, optional): what method ``none`` is called. Defaults to its usual name.

    Returns:
        Figure: as wide as two columns, or one for a single panel.

    Raises:
        ValueError: there is nothing to draw.

    Examples:
        >>> figure = interval_panels({"Hopper": {"e2r": ConfidenceInterval(0.2, 0.1, 0.4)}})
        >>> [label.get_text() for label in figure.axes[0].get_yticklabels()]
        ['E2R']
    """
    names = _names(panels)
    styles = variant_styles(names)
    legend = 0.35 if reference else 0.0
    figure, axes = _panels(panels, columns, places, row_height=0.45 + 0.19 * len(names), legend=legend)
    for (title, intervals), ax in zip(panels.items(), axes.values(), strict=True):
        for row, name in enumerate(names):
            if name in intervals:
                middle, low, high = (scale * float(value) for value in intervals[name])
                color, point = styles[name]["color"], low == high  # which would have no colour without an edge
                edge: dict[str, Any] = {"edgecolor": color, "linewidth": 3.5} if point else {"linewidth": 0}
                ax.barh(row, high - low, left=low, height=0.62, color=color, alpha=0.75, **edge)
                ax.vlines(middle, row - 0.31, row + 0.31, color=_INK, linewidth=1.3, zorder=3)
            if name in (other := (reference or {}).get(title, {})):
                middle, low, high = (scale * float(value) for value in other[name])
                ax.hlines(row, low, high, color=_INK, linewidth=0.7, zorder=4)
                ax.plot([middle], [row], **_MARKER)
        ax.axvline(center, color="0.35", linestyle=(0, (3, 2)), linewidth=0.9, zorder=1.5)
        ax.set_title(title, linespacing=1.05)
        ax.set_yticks(range(len(names)), [variant_label(name, baseline) for name in names])
        ax.set_ylim(len(names) - 0.45, -0.55)
        ax.tick_params(axis="y", length=0)
        ax.grid(visible=False, axis="y")
        ax.spines["left"].set_visible(False)
        ax.use_sticky_edges = False
        ax.margins(x=0.06)
        if xlim:
            ax.set_xlim(*xlim)
        ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    outer_labels(axes, xlabel, "", share_y=True)
    if reference:
        bar, line = Patch(color="0.6", linewidth=0, label="Interval"), {**_MARKER, "marker": "|", "markersize": 8}
        handles: list[Any] = [Line2D([], [], label="Estimate", **line), bar]
        handles.append(Line2D([], [], label="Paper", **_MARKER))
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), columnspacing=1.6)
    return figure


def _names(panels: Mapping[str, Mapping[str, Any]]) -> list[str]:
    names = list(dict.fromkeys(name for shown in panels.values() for name in shown))
    if not names:
        raise ValueError("There is nothing to draw.")
    return names


def _panels(
    panels: Mapping[str, Any],
    columns: int | None,
    places: Places | None,
    *,
    row_height: float,
    legend: float = 0.35,
    share_y: bool = False,
) -> tuple[Figure, dict[tuple[int, int], Axes]]:
    """An empty panel per title, by row and column."""
    columns = min(len(panels), columns or 3)
    cells = [divmod(index, columns) for index in range(len(panels))]
    if places is not None:
        cells = [places[title] for title in panels]
        columns = 1 + max(column for _, column in cells)
    rows = 1 + max(row for row, _ in cells)
    width = {1: COLUMN_WIDTH, 2: 1.5 * COLUMN_WIDTH}.get(columns, TEXT_WIDTH)
    figure = new_figure(width, legend + row_height * rows)
    grid = figure.add_gridspec(rows, columns)
    axes: dict[tuple[int, int], Axes] = {}
    for cell in cells:
        axes[cell] = figure.add_subplot(grid[cell], sharey=next(iter(axes.values())) if share_y and axes else None)
    return figure, axes


def _draw_band(ax: Axes, x: Any, band: ConfidenceInterval, style: dict[str, Any], name: str) -> None:
    middle, low, high = (np.asarray(values, dtype=np.float64) for values in band)
    if not x.shape == middle.shape == low.shape == high.shape:
        raise ValueError(f"The {name} has {middle.shape} points, its axis {x.shape}.")
    color = style["color"]
    ax.fill_between(x, low, high, color=color, alpha=0.16, linewidth=0, zorder=2)
    marker: dict[str, Any] = {"marker": "o", "markersize": 3} if len(x) == 1 else {}
    ax.plot(x, middle, solid_capstyle="round", **style, **marker)


def _legend(
    figure: Figure, styles: dict[str, dict[str, Any]], baseline: str | None, more: Sequence[Line2D] = ()
) -> None:
    handles = [Line2D([], [], label=variant_label(name, baseline), **style) for name, style in styles.items()]
    handles += more
    # what fits: some six points a letter, and a line before each
    fits = int(figure.get_figwidth() * 72 / (34 + 4.4 * max(len(_plain(handle.get_label())) for handle in handles)))
    rows = -(-len(handles) // max(1, fits))
    columns = -(-len(handles) // rows)
    figure.set_figheight(figure.get_figheight() + 0.16 * (rows - 1))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, columnspacing=1.4)


def _plain(label: Any) -> str:
    return str(label).replace(r"$C_\omega$", "Cw")
