"""How runs are compared: areas under learning curves, robust aggregates and their bootstrapped confidence intervals.

The aggregates are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice"
(2021), the area ratio that of Centa & Preux. Everything is NumPy only, takes arrays, nested lists or tensors (of any
device), and draws from a :class:`numpy.random.Generator` of its own: the same seed gives the same interval, whatever
ran before.
"""

from recipes.metrics.area import RATIO_LIMIT, area_ratio, area_under_curve
from recipes.metrics.bootstrap import iqm, mean_confidence_interval, stratified_bootstrap_ci
from recipes.metrics.comparison import performance_profile, probability_of_improvement, share_of_runs
from recipes.metrics.interval import MIN_RUNS, ConfidenceInterval

__all__ = [
    "MIN_RUNS",
    "RATIO_LIMIT",
    "ConfidenceInterval",
    "area_ratio",
    "area_under_curve",
    "iqm",
    "mean_confidence_interval",
    "performance_profile",
    "probability_of_improvement",
    "share_of_runs",
    "stratified_bootstrap_ci",
]
