"""Learning speed: the area under an evaluation curve, and its ratio to the baseline's."""

from __future__ import annotations

from typing import Any

import numpy as np

from recipes.metrics.interval import as_array, unwrap

__all__ = ["RATIO_LIMIT", "area_ratio", "area_under_curve"]

RATIO_LIMIT = 1e6
"""What stands for an infinite area ratio: large enough to be trimmed by any robust aggregate, finite enough to sort."""


def area_under_curve(returns: Any) -> Any:
    r"""Area under an evaluation curve divided by the number of timesteps, :math:`A = \frac1N\sum_{i=1}^N G_i`.

    With evaluations evenly spaced in time this is their mean, in the unit of the return, and comparable across
    training budgets.

    Args:
        returns: evaluation returns, ``[*runs, points]``.

    Returns:
        float or ndarray: ``[*runs]``.

    Raises:
        ValueError: ``returns`` is empty, a single number, or isn't finite.

    Examples:
        >>> area_under_curve([[0.0, 1.0, 2.0], [3.0, 3.0, 3.0]])
        array([1., 3.])
    """
    array = as_array(returns, "returns")
    if array.ndim == 0:
        raise ValueError("returns needs a dimension of evaluation points, got a single number.")
    return unwrap(array.mean(-1))


def area_ratio(area_prior: Any, area: Any, *, limit: float = RATIO_LIMIT) -> Any:
    r"""Learning speed-up over the baseline, :math:`r_{\pi_0} = (A_{\pi_0} - A) / A` (Centa & Preux).

    The baseline's area may be 0 or negative. 0/0 is 0 (nothing gained, nothing lost), x/0 is ``limit`` with the sign
    of x, and no ratio is beyond ``limit``. For :math:`A < 0` the formula is kept as it stands, though its sign then
    reads the other way round. Ratios are therefore heavy-tailed: aggregate them with :func:`iqm`, never with a mean.

    Args:
        area_prior: area with the prior, any shape.
        area: area of the baseline on the same run; broadcasts with ``area_prior``.

    Keyword Args:
        limit (float): the magnitude given to x/0 and the bound of all ratios. Defaults to :data:`RATIO_LIMIT`.

    Returns:
        float or ndarray: the ratio, of the broadcast shape.

    Raises:
        ValueError: an argument is empty or isn't finite.

    Examples:
        >>> area_ratio([3.0, 0.0, -1.0], [2.0, 0.0, 0.0])
        array([ 5.e-01,  0.e+00, -1.e+06])
    """
    with_prior, base = as_array(area_prior, "area_prior"), as_array(area, "area")
    gain = with_prior - base
    at_zero = np.sign(gain) * limit
    # a subnormal area may overflow the quotient: it is clipped like any other
    with np.errstate(over="ignore"):
        ratio = np.where(base == 0, at_zero, gain / np.where(base == 0, 1.0, base))
    return unwrap(np.clip(ratio, -limit, limit))
