"""Distributions of scores side by side: performance profiles, the probability of improvement, shares of runs."""

from __future__ import annotations

from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from recipes.metrics.bootstrap import stratified_bootstrap_ci
from recipes.metrics.interval import CHUNK, Array, ConfidenceInterval, as_array, as_scores, interval, tails

__all__ = ["performance_profile", "probability_of_improvement", "share_of_runs"]


def performance_profile(
    scores: Any,
    thresholds: Any,
    *,
    confidence: float = 0.95,
    reps: int = 2000,
    seed: int | np.random.Generator = 0,
) -> ConfidenceInterval:
    r"""Share of the runs that score above each threshold, :math:`\hat F(\tau) = \frac1{MN}\sum_{m,n} 1[x_{mn} > \tau]`.

    The interval is the pointwise stratified bootstrap (percentile). The number of scores that a resample of a task
    puts between two thresholds is multinomial, so it is drawn directly, at a cost that doesn't grow with the runs.

    Args:
        scores: ``[runs]`` or ``[runs, tasks]``.
        thresholds: ``[points]``, in any order.

    Keyword Args:
        confidence (float): in (0, 1). Defaults to 0.95.
        reps (int): number of resamples. Defaults to 2000.
        seed (int or numpy.random.Generator): the same seed gives the same interval. Defaults to 0.

    Returns:
        ConfidenceInterval: arrays ``[points]`` in [0, 1].

    Raises:
        ValueError: an argument has the wrong rank, is empty or isn't finite, or ``confidence`` or ``reps`` is out of
            range.

    Examples:
        >>> performance_profile([0.0, 1.0, 2.0, 3.0], [-1.0, 1.0, 2.5]).estimate
        array([1.  , 0.5 , 0.25])
    """
    array, taus, quantiles = as_scores(scores, "scores"), as_array(thresholds, "thresholds"), tails(confidence, reps)
    if array.ndim != 2 or taus.ndim != 1:
        raise ValueError(f"Expected scores [runs, tasks] and thresholds [points], got {array.shape} and {taus.shape}.")
    rng = np.random.default_rng(seed)
    (runs, tasks), points = array.shape, len(taus)
    order = np.argsort(taus, kind="stable")
    passed = np.searchsorted(taus[order], array, side="left")  # how many thresholds each score is above
    rank = np.argsort(order, kind="stable")

    def profile(counts: npt.NDArray[np.int64]) -> Array:
        """From the number of scores above exactly 0..points thresholds, [..., points + 1], to shares, [..., points]."""
        above = counts[..., ::-1].cumsum(-1)[..., ::-1][..., 1:]
        return above[..., rank] / (runs * tasks)

    histogram = np.stack([np.bincount(passed[:, task], minlength=points + 1) for task in range(tasks)])
    resampled = np.zeros((reps, points + 1), dtype=np.int64)
    for task in range(tasks):
        resampled += rng.multinomial(runs, histogram[task] / runs, size=reps)
    return interval(profile(histogram.sum(0)), profile(resampled), quantiles)


def probability_of_improvement(
    x: Any,
    y: Any,
    *,
    paired: bool = False,
    confidence: float = 0.95,
    reps: int = 2000,
    seed: int | np.random.Generator = 0,
) -> ConfidenceInterval:
    r"""How probably a run of x beats a run of y, :math:`P(X > Y) + \frac12 P(X = Y)`, averaged over the tasks.

    Unpaired (Agarwal et al. 2021), every run of x meets every run of y of the same task (Mann-Whitney's U), and both
    sides are resampled independently. Paired, run i of x meets run i of y only: right, and sharper, where both were
    run on the same world and seed.

    Args:
        x: ``[runs_x]`` or ``[runs_x, tasks]``.
        y: ``[runs_y]`` or ``[runs_y, tasks]``.

    Keyword Args:
        paired (bool): whether run i of x and of y share their world. Defaults to ``False``.
        confidence (float): in (0, 1). Defaults to 0.95.
        reps (int): number of resamples. Defaults to 2000.
        seed (int or numpy.random.Generator): the same seed gives the same interval. Defaults to 0.

    Returns:
        ConfidenceInterval: floats in [0, 1]; 0.5 is a draw.

    Raises:
        ValueError: the shapes don't match, an argument is empty or not finite, or ``confidence`` or ``reps`` is out of
            range.

    Examples:
        >>> probability_of_improvement([1.0, 2.0], [0.0, 2.0]).estimate  # two wins, a loss, a tie
        0.625
    """
    left, right, quantiles = as_scores(x, "x"), as_scores(y, "y"), tails(confidence, reps)
    if left.ndim != 2 or right.ndim != 2 or left.shape[1] != right.shape[1]:
        raise ValueError(f"x and y need the same tasks: expected [runs, tasks] twice, got {left.shape}, {right.shape}.")
    if paired:
        if left.shape != right.shape:
            raise ValueError(f"Paired runs need equal shapes, got {left.shape} and {right.shape}.")
        wins = (left > right) + 0.5 * (left == right)
        return stratified_bootstrap_ci(wins, np.mean, confidence=confidence, reps=reps, seed=seed)
    rng = np.random.default_rng(seed)
    estimate, replicates = 0.0, np.zeros(reps)
    for task in range(left.shape[1]):
        a, b = left[:, task], np.sort(right[:, task])
        below, up_to = np.searchsorted(b, a, side="left"), np.searchsorted(b, a, side="right")
        # half the runs of y below a plus half of those not above it: ties count one half
        estimate += float((below + up_to).mean()) / (2 * len(b))
        chunk = max(1, CHUNK // (len(a) + len(b)))
        for start in range(0, reps, chunk):
            rows = min(chunk, reps - start)
            cumulative = np.zeros((rows, len(b) + 1))
            np.cumsum(_resample_counts(rng, rows, len(b)), axis=1, out=cumulative[:, 1:])
            drawn = rng.integers(len(a), size=(rows, len(a)))
            beaten = np.take_along_axis(cumulative, below[drawn], 1) + np.take_along_axis(cumulative, up_to[drawn], 1)
            replicates[start : start + rows] += beaten.mean(1) / (2 * len(b))
    tasks = left.shape[1]
    return interval(estimate / tasks, replicates / tasks, quantiles)


def share_of_runs(hits: Any, *, confidence: float = 0.95) -> ConfidenceInterval:
    r"""Share of the runs of which something is true, and its interval, :math:`|\hat p - p| \leq z\sqrt{p(1-p)/n}`.

    The interval is that of Wilson (1927). Unlike a bootstrap's it has a width where all runs agree, so it serves few
    runs too.

    Args:
        hits: booleans, ``[runs]``.

    Keyword Args:
        confidence (float): in (0, 1). Defaults to 0.95.

    Returns:
        ConfidenceInterval: floats in [0, 1].

    Raises:
        ValueError: ``hits`` is empty or has another rank, or ``confidence`` is out of range.

    Examples:
        >>> share, low, high = share_of_runs([True, False, False, False])
        >>> print(f"{share} ({low:.2f}, {high:.2f})")
        0.25 (0.05, 0.70)
    """
    array, quantiles = as_array(hits, "hits"), tails(confidence)
    if array.ndim != 1:
        raise ValueError(f"Expected hits [runs], got {array.shape}.")
    count, share, z = len(array), float((array != 0).mean()), NormalDist().inv_cdf(quantiles[1])
    centre = share + z**2 / (2 * count)
    half = z * float(np.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2))
    low, high = ((centre + sign * half) / (1 + z**2 / count) for sign in (-1, 1))
    return ConfidenceInterval(share, min(max(low, 0.0), share), max(min(high, 1.0), share))


def _resample_counts(rng: np.random.Generator, rows: int, count: int) -> npt.NDArray[np.int64]:
    """How often each of ``count`` items is drawn in each of ``rows`` resamples with replacement, ``[rows, count]``."""
    drawn = rng.integers(count, size=(rows, count)) + count * np.arange(rows)[:, None]
    return np.bincount(drawn.reshape(-1), minlength=rows * count).reshape(rows, count)
