"""Figures in the form of the paper's (Centa & Preux), from plain arrays.

Every function returns a :class:`matplotlib.figure.Figure` and leaves no trace in pyplot or matplotlib's settings, so
that it works in a job without a display and in a notebook alike (but one figure at a time: matplotlib's settings are
shared by all threads while a figure is made). Needs matplotlib (``pip install torchrl-priors[recipes]``).
"""

from torchrl_priors.plots.curves import learning_curves, performance_profiles
from torchrl_priors.plots.grid import grid_world
from torchrl_priors.plots.intervals import iqm_bars
from torchrl_priors.plots.style import method_color, method_label, prior_label, save_figure
from torchrl_priors.plots.weights import episode_weights, weight_curves, weight_maps

__all__ = [
    "episode_weights",
    "grid_world",
    "iqm_bars",
    "learning_curves",
    "method_color",
    "method_label",
    "performance_profiles",
    "prior_label",
    "save_figure",
    "weight_curves",
    "weight_maps",
]
