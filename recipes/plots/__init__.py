"""Figures in the form of the paper's (Centa & Preux), from plain arrays.

Every function returns a :class:`matplotlib.figure.Figure` and leaves no trace in pyplot or matplotlib's settings, so
that it works in a job without a display and in a notebook alike (but one figure at a time: matplotlib's settings are
shared by all threads while a figure is made). Needs matplotlib (``pip install torchrl-priors[recipes]``).
"""

from recipes.plots.grid import grid_world
from recipes.plots.panels import curve_panels, interval_panels, profile_panels
from recipes.plots.style import method_color, method_label, prior_label, save_figure
from recipes.plots.weights import episode_weights, weight_curves, weight_maps

__all__ = [
    "curve_panels",
    "episode_weights",
    "grid_world",
    "interval_panels",
    "method_color",
    "method_label",
    "prior_label",
    "profile_panels",
    "save_figure",
    "weight_curves",
    "weight_maps",
]
