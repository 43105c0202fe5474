"""Learning curves and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, PercentFormatter

from torchrl_priors.metrics import ConfidenceInterval, mean_confidence_interval, performance_profile
from torchrl_priors.plots.style import (
    BASELINE,
    COLUMN_WIDTH,
    TEXT_WIDTH,
    line_style,
    method_color,
    method_handles,
    new_figure,
    outer_labels,
    panel_positions,
    paper_style,
    prior_label,
    thousands,
)

__all__ = ["learning_curves", "performance_profiles"]

_PROFILE_LABELS = (r"Area ratio $\tau$", r"Runs with $r_{\pi_0} > \tau$")


@paper_style
def learning_curves(
    curves: Mapping[str, Mapping[str, Any]],
    *,
    baseline: Any = None,
    steps: Any = None,
    profiles: Mapping[str, Any] | None = None,
    thresholds: Any = None,
    confidence: float = 0.95,
    share_y: bool = True,
    xlabel: str = "Transitions",
    ylabel: str = "Return",
) -> Figure:
    """Learning curves, a panel per prior (or environment) with pointwise bands, and performance profiles beside them.

    The paper's seven priors take the places of its figure: expert prior and profiles in the first column, random
    degradations above structural ones, quality falling from left to right.

    Args:
        curves: returns by prior and method. Each is ``[runs, points]``, of which the mean and its pointwise
            normal-approximation interval are drawn, or a :class:`~torchrl_priors.metrics.ConfidenceInterval` of
            arrays ``[points]``, which is drawn as it is.

    Keyword Args:
        baseline: the same for the run without a prior, in every panel (black, dashed); or a mapping from prior to it.
        steps: where the points are, ``[points]``, in transitions. Defaults to 1, 2, …
        profiles: by method, the area ratios ``[runs]`` or ``[runs, tasks]`` or their profile as a
            :class:`~torchrl_priors.metrics.ConfidenceInterval`; adds a panel like :func:`performance_profiles`.
        thresholds: where the profiles are evaluated. Defaults to 201 points from -1 to 1.
        confidence (float): of bands computed here. Defaults to 0.95.
        share_y (bool): whether all panels have one scale of returns, as panels of one environment should.
        xlabel, ylabel (str): names of the axes.

    Returns:
        Figure: as wide as two columns.

    Raises:
        ValueError: there are no curves, or a curve doesn't have the points of ``steps``; the message names it.

    Examples:
        >>> returns = np.random.default_rng(0).normal(size=(20, 10)).cumsum(1)
        >>> figure = learning_curves({"expert": {"e2r": returns + 1, "ae2r": returns + 2}}, baseline=returns)
        >>> len(figure.axes)
        1
    """
    if not curves or not any(curves.values()):
        raise ValueError("There are no curves to draw.")
    names = list(curves)
    rows, columns, positions, extra = panel_positions(names, profiles is not None)
    figure = new_figure(TEXT_WIDTH if columns > 1 else COLUMN_WIDTH, 0.35 + 1.55 * rows if columns > 1 else 2.5)
    grid = figure.add_gridspec(rows, columns)
    panels: dict[tuple[int, int], Axes] = {}
    first: Axes | None = None
    for name, (row, column) in zip(names, positions, strict=True):
        ax = figure.add_subplot(grid[row, column], sharey=first if share_y else None)
        first = first or ax
        panels[row, column] = ax
        lines = dict(curves[name])
        base = baseline.get(name) if isinstance(baseline, Mapping) else baseline
        if base is not None:
            lines[BASELINE] = base
        for method, curve in lines.items():
            _draw_curve(ax, method, _as_band(curve, confidence), steps, f"curve {method!r} of {name!r}")
        ax.set_title(prior_label(name))
        ax.xaxis.set_major_formatter(FuncFormatter(thousands))
        ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        ax.margins(x=0)
    outer_labels(panels, xlabel, ylabel, share_y)
    methods = list(dict.fromkeys(method for by_method in curves.values() for method in by_method))
    if profiles is not None and extra is not None:
        ax = figure.add_subplot(grid[extra])
        _draw_profiles(ax, profiles, thresholds, confidence)
        ax.set_title("Performance profiles")
        methods += [method for method in profiles if method not in methods]
    if baseline is not None and BASELINE not in methods:
        methods.append(BASELINE)
    figure.legend(handles=method_handles(methods), loc="outside lower center", ncols=len(methods), columnspacing=1.6)
    return figure


@paper_style
def performance_profiles(
    profiles: Mapping[str, Any],
    thresholds: Any = None,
    *,
    confidence: float = 0.95,
    xlabel: str = _PROFILE_LABELS[0],
    ylabel: str = _PROFILE_LABELS[1],
) -> Figure:
    r"""Share of the runs whose score exceeds a threshold, :math:`\hat F(\tau)`, per method; the dashed line marks 0.

    Args:
        profiles: by method, scores ``[runs]`` or ``[runs, tasks]`` (their profile and its stratified bootstrap
            interval are drawn), or a :class:`~torchrl_priors.metrics.ConfidenceInterval` at ``thresholds``.
        thresholds: ``[points]``, ascending. Defaults to 201 points from -1 to 1.

    Keyword Args:
        confidence (float): of bands computed here. Defaults to 0.95.
        xlabel, ylabel (str): names of the axes.

    Returns:
        Figure: as wide as one column.

    Raises:
        ValueError: there are no profiles, or one doesn't have the points of ``thresholds``; the message names it.

    Examples:
        >>> ratios = np.random.default_rng(0).normal(scale=0.3, size=(50, 2))
        >>> len(performance_profiles({"e2r": ratios, "ae2r": ratios + 0.1}).axes)
        1
    """
    figure = new_figure(COLUMN_WIDTH, 2.3)
    ax = figure.add_subplot()
    _draw_profiles(ax, profiles, thresholds, confidence)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    columns = len(profiles) if len(profiles) <= 4 else -(-len(profiles) // 2)
    figure.legend(handles=method_handles(profiles), loc="outside lower center", ncols=columns, columnspacing=1.6)
    return figure


def _as_band(curve: Any, confidence: float) -> ConfidenceInterval:
    return curve if isinstance(curve, ConfidenceInterval) else mean_confidence_interval(curve, confidence=confidence)


def _draw_curve(ax: Axes, method: str, band: ConfidenceInterval, where: Any, name: str) -> None:
    center, low, high = (np.asarray(field, dtype=np.float64) for field in band)
    x = np.arange(1, len(center) + 1) if where is None else np.asarray(where, dtype=np.float64)
    if not x.shape == center.shape == low.shape == high.shape:
        raise ValueError(f"The {name} has {center.shape} points, its axis {x.shape}.")
    ax.fill_between(
        x, low, high, color=method_color(method), alpha=0.12 if method == BASELINE else 0.2, linewidth=0, zorder=2
    )
    ax.plot(x, center, solid_capstyle="round", **line_style(method))


def _draw_profiles(ax: Axes, profiles: Mapping[str, Any], thresholds: Any, confidence: float) -> None:
    if not profiles:
        raise ValueError("There are no profiles to draw.")
    taus = np.linspace(-1, 1, 201) if thresholds is None else np.asarray(thresholds, dtype=np.float64)
    ax.axvline(0, color="0.35", linestyle=(0, (3, 2)), linewidth=0.9, zorder=1.5)
    for method, scores in profiles.items():
        ready = isinstance(scores, ConfidenceInterval)
        band = scores if ready else performance_profile(scores, taus, confidence=confidence)
        _draw_curve(ax, method, band, taus, f"profile of {method!r}")
    ax.set(xlabel=_PROFILE_LABELS[0], ylabel=_PROFILE_LABELS[1], xlim=(taus.min(), taus.max()), ylim=(0, 1))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.xaxis.set_major_locator(MaxNLocator(4))
