"""Robust aggregates of many runs and their confidence intervals."""

from __future__ import annotations

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np

from recipes.metrics.interval import CHUNK, ConfidenceInterval, as_array, as_scores, interval, tails, unwrap

__all__ = ["iqm", "mean_confidence_interval", "stratified_bootstrap_ci"]


def iqm(scores: Any, axis: int | None = None) -> Any:
    """Interquartile mean: the mean of what is left when the lowest and the highest quarter are cut off.

    A quarter is rounded down to whole scores, as ``scipy.stats.trim_mean(scores, 0.25)`` does.

    Args:
        scores: any shape.
        axis (int, optional): the axis to aggregate; all of them by default.

    Returns:
        float or ndarray: the shape of ``scores`` without ``axis``.

    Raises:
        ValueError: ``scores`` is empty or isn't finite.

    Examples:
        >>> iqm([-1e6, 1.0, 2.0, 1e6])
        1.5
    """
    array = as_array(scores, "scores")
    array = array.reshape(-1) if axis is None else np.moveaxis(array, axis, -1)
    count = array.shape[-1]
    cut = count // 4
    if cut:
        array = np.partition(array, (cut, count - cut - 1), axis=-1)[..., cut : count - cut]
    return unwrap(array.mean(-1))


def mean_confidence_interval(scores: Any, *, axis: int = 0, confidence: float = 0.95) -> ConfidenceInterval:
    r"""Mean over runs and its normal-approximation interval, :math:`\bar x \pm z\,s/\sqrt n` (z = 1.96 at 95 %).

    It is the interval of pointwise bands around curves averaged over many runs. With a single run it is as wide as a
    point, since nothing is known about the spread.

    Args:
        scores: any shape.

    Keyword Args:
        axis (int): the dimension of the runs. Defaults to 0.
        confidence (float): in (0, 1). Defaults to 0.95.

    Returns:
        ConfidenceInterval: each field of the shape of ``scores`` without ``axis``.

    Raises:
        ValueError: ``scores`` is empty, a single number, or isn't finite; or ``confidence`` is out of range.

    Examples:
        >>> mean, low, high = mean_confidence_interval([1.0, 3.0])
        >>> mean, round(low, 2), round(high, 2)
        (2.0, 0.04, 3.96)
    """
    array, (_, upper) = as_array(scores, "scores"), tails(confidence)
    if array.ndim == 0:
        raise ValueError("scores needs a dimension of runs, got a single number.")
    count = array.shape[axis]
    mean = array.mean(axis)
    error = array.std(axis, ddof=1) / np.sqrt(count) if count > 1 else np.zeros_like(mean)
    margin = NormalDist().inv_cdf(upper) * error
    return ConfidenceInterval(unwrap(mean), unwrap(mean - margin), unwrap(mean + margin))


def stratified_bootstrap_ci(
    scores: Any,
    statistic: Callable[..., Any] = iqm,
    *,
    confidence: float = 0.95,
    reps: int = 2000,
    seed: int | np.random.Generator = 0,
) -> ConfidenceInterval:
    """Percentile interval of a statistic, by resampling the runs of each task with replacement (Agarwal et al. 2021).

    Runs are resampled whole: along the trailing dimensions (the points of a curve, the two sides of a paired
    comparison) a run keeps its values together.

    Args:
        scores: ``[runs]``, ``[runs, tasks]`` or ``[runs, tasks, *rest]``; each task is a stratum.
        statistic (Callable): called as ``statistic(sample, axis=1)`` on ``[resamples, runs * tasks, *rest]``; it
            aggregates that axis, e.g. :func:`iqm` (default), :func:`numpy.mean`, :func:`numpy.median`.

    Keyword Args:
        confidence (float): in (0, 1). Defaults to 0.95.
        reps (int): number of resamples. Defaults to 2000.
        seed (int or numpy.random.Generator): the same seed gives the same interval. Defaults to 0.

    Returns:
        ConfidenceInterval: floats, or arrays ``[*rest]``.

    Raises:
        ValueError: ``scores`` is empty or isn't finite, or ``confidence`` or ``reps`` is out of range.

    Examples:
        >>> estimate, low, high = stratified_bootstrap_ci(range(100))
        >>> estimate, low < estimate < high
        (49.5, True)

        How much better is x than y on the same runs? The interval of a paired difference:

        >>> rng = np.random.default_rng(0)
        >>> y = rng.normal(scale=100, size=50)
        >>> x = y + rng.normal(1.0, 0.1, size=50)
        >>> def gap(sample, axis):
        ...     return np.subtract(*np.moveaxis(np.mean(sample, axis=axis), -1, 0))
        >>> stratified_bootstrap_ci(np.stack([x, y], -1)[:, None], gap).low > 0.9
        True
    """
    array, quantiles, rng = as_scores(scores, "scores"), tails(confidence, reps), np.random.default_rng(seed)
    runs, tasks, *rest = array.shape
    offsets = np.arange(tasks)
    flat = array.reshape(runs * tasks, *rest)
    replicates = []
    chunk = max(1, CHUNK // array.size)
    for start in range(0, reps, chunk):
        drawn = rng.integers(runs, size=(min(chunk, reps - start), runs, tasks))
        index = (drawn * tasks + offsets).reshape(len(drawn), runs * tasks)
        replicates.append(np.asarray(statistic(flat[index], axis=1)))
    estimate = np.asarray(statistic(flat[None], axis=1))[0]
    return interval(estimate, np.concatenate(replicates), quantiles)
