"""What every metric shares: scores as checked arrays, and intervals from bootstrap replicates."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["CHUNK", "MIN_RUNS", "Array", "ConfidenceInterval", "as_array", "as_scores", "interval", "tails", "unwrap"]

CHUNK = 1 << 20
"""Numbers resampled at once: 8 MiB of indices, so that the working set stays in the caches."""

MIN_RUNS = 4
"""Runs below which the bootstrap's interval is far too narrow to be shown: three runs have ten different resamples."""

Array = npt.NDArray[np.float64]


class ConfidenceInterval(NamedTuple):
    """An estimate and the ends of its confidence interval; floats, or arrays of one shape (a curve, a profile)."""

    estimate: Any
    low: Any
    high: Any


def as_array(values: Any, name: str) -> Array:
    """A float64 array of an array-like or a tensor; refuses what sorting would hide in a tail (NaN), and emptiness."""
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        raise ValueError(f"{name} is empty (shape {array.shape}).")
    if not (finite := np.isfinite(array)).all():
        raise ValueError(f"{name} holds {int((~finite).sum())} NaN or infinite values among {array.size}.")
    return array


def as_scores(values: Any, name: str) -> Array:
    """Scores as ``[runs, tasks, *rest]``."""
    scores = as_array(values, name)
    if scores.ndim == 0:
        raise ValueError(f"{name} needs a dimension of runs, got a single number.")
    return scores[:, None] if scores.ndim == 1 else scores


def tails(confidence: float, reps: int = 1) -> list[float]:
    """The two quantiles that bound a central interval; refuses settings out of range."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must lie strictly between 0 and 1, got {confidence}.")
    if reps < 1:
        raise ValueError(f"reps must be at least 1, got {reps}.")
    return [(1 - confidence) / 2, (1 + confidence) / 2]


def unwrap(value: Any) -> Any:
    """A float of a 0-d array, an array of anything else."""
    return float(value) if np.ndim(value) == 0 else value


def interval(estimate: Any, replicates: Array, quantiles: list[float]) -> ConfidenceInterval:
    """The percentile interval of an estimate from its bootstrap replicates, ``[reps, *shape]``."""
    low, high = np.quantile(replicates, quantiles, axis=0)
    return ConfidenceInterval(unwrap(estimate), unwrap(low), unwrap(high))
