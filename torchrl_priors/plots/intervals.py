"""Aggregates with their confidence intervals, a panel per prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from torchrl_priors.metrics import ConfidenceInterval, stratified_bootstrap_ci
from torchrl_priors.plots.style import (
    TEXT_WIDTH,
    method_color,
    method_label,
    new_figure,
    outer_labels,
    panel_positions,
    paper_style,
    prior_label,
)

__all__ = ["iqm_bars"]

_INK = "#222222"


@paper_style
def iqm_bars(
    scores: Mapping[str, Mapping[str, Any]],
    *,
    reference: Mapping[str, Mapping[str, Any]] | None = None,
    reference_label: str = "Paper",
    scale: float = 1e3,
    confidence: float = 0.95,
    xlabel: str = r"IQM of $r_{\pi_0}$ ($\times 10^{-3}$)",
) -> Figure:
    """Interquartile means per prior and method: a line at the estimate, a bar over its confidence interval.

    Each panel has its own scale, which always holds 0 (dashed): no improvement over the baseline.

    Args:
        scores: by prior and method, area ratios ``[runs]`` (their IQM and bootstrap interval are drawn), or a
            :class:`~torchrl_priors.metrics.ConfidenceInterval` of floats.

    Keyword Args:
        reference: values to compare with, by prior and method (any may be missing), in the unit of ``scores``: a
            number, or a :class:`~torchrl_priors.metrics.ConfidenceInterval` whose ends are drawn as whiskers.
        reference_label (str): their name in the legend. Defaults to ``"Paper"``.
        scale (float): what values are multiplied with before they are drawn. Defaults to 1000.
        confidence (float): of intervals computed here. Defaults to 0.95.
        xlabel (str): name of the axis.

    Returns:
        Figure: as wide as two columns.

    Raises:
        ValueError: there is nothing to draw.

    Examples:
        >>> figure = iqm_bars(
        ...     {"expert": {"er": ConfidenceInterval(0.03, 0.02, 0.04), "ae2r": [0.01, 0.02, 0.03]}},
        ...     reference={"expert": {"er": 0.036}},
        ... )
        >>> [label.get_text() for label in figure.axes[0].get_yticklabels()]
        ['ER', 'AE2R']
    """
    methods = list(dict.fromkeys(method for by_method in scores.values() for method in by_method))
    if not methods:
        raise ValueError("There are no scores to draw.")
    names = list(scores)
    rows, columns, positions, extra = panel_positions(names, extra=False)
    figure = new_figure(TEXT_WIDTH, 0.35 + rows * (0.45 + 0.2 * len(methods)))
    grid = figure.add_gridspec(rows, columns)
    panels: dict[tuple[int, int], Axes] = {}
    for name, position in zip(names, positions, strict=True):
        ax = panels[position] = figure.add_subplot(grid[position])
        published = (reference or {}).get(name, {})
        for row, method in enumerate(methods):
            if method in scores[name]:
                value = scores[name][method]
                ready = isinstance(value, ConfidenceInterval)
                _draw_interval(
                    ax, row, method, value if ready else stratified_bootstrap_ci(value, confidence=confidence), scale
                )
            if method in published:
                _draw_reference(ax, row, published[method], scale)
        ax.axvline(0, color="0.35", linestyle=(0, (3, 2)), linewidth=0.9, zorder=1.5)
        ax.set_title(prior_label(name))
        ax.set_yticks(range(len(methods)), [method_label(method) for method in methods])
        ax.set_ylim(len(methods) - 0.45, -0.55)
        ax.tick_params(axis="y", length=0)
        ax.grid(visible=False, axis="y")
        ax.spines["left"].set_visible(False)
        ax.use_sticky_edges = False
        ax.margins(x=0.06)
        ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    outer_labels(panels, xlabel, "", share_y=True)
    _add_legend(
        figure, figure.add_subplot(grid[extra]) if extra else None, reference_label if reference else None, confidence
    )
    return figure


def _draw_interval(ax: Axes, row: int, method: str, interval: ConfidenceInterval, scale: float) -> None:
    estimate, low, high = (scale * float(value) for value in interval)
    ax.barh(row, high - low, left=low, height=0.62, color=method_color(method), alpha=0.75, linewidth=0, zorder=2)
    ax.vlines(estimate, row - 0.31, row + 0.31, color=_INK, linewidth=1.3, zorder=3)


def _draw_reference(ax: Axes, row: int, value: Any, scale: float) -> None:
    if isinstance(value, ConfidenceInterval):
        ax.hlines(row, scale * float(value.low), scale * float(value.high), color=_INK, linewidth=0.7, zorder=4)
        value = value.estimate
    ax.plot([scale * float(value)], [row], **_reference_marker())


def _reference_marker() -> dict[str, Any]:
    return {
        "marker": "D",
        "markersize": 3.6,
        "markerfacecolor": "white",
        "markeredgecolor": _INK,
        "markeredgewidth": 0.8,
        "linestyle": "none",
        "zorder": 5,
    }


def _add_legend(figure: Figure, ax: Axes | None, reference: str | None, confidence: float) -> None:
    """What bar, line and marker mean, in the free panel where there is one, else below."""
    handles: list[Any] = [
        Line2D(
            [],
            [],
            color=_INK,
            linewidth=1.3,
            linestyle="none",
            marker="|",
            markersize=8,
            markeredgewidth=1.3,
            label="IQM",
        ),
        Patch(color="0.6", linewidth=0, label=f"{100 * confidence:g}% CI"),
        Line2D([], [], color="0.35", linestyle=(0, (3, 2)), linewidth=0.9, label="Baseline"),
    ]
    if reference:
        handles.append(Line2D([], [], label=reference, **_reference_marker()))
    if ax is None:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), columnspacing=1.6)
    else:
        ax.set_axis_off()
        ax.legend(handles=handles, loc="center", labelspacing=0.8)
