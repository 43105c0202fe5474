"""Metrics against the reference implementation, rliable 1.2.0, whose numbers are kept here: it needs an old pandas.

Its intervals come from 4000 resamples (of the probability of improvement 1000) after ``np.random.seed(0)``, so they and
ours agree in law only.
"""

from __future__ import annotations

import numpy as np
import pytest

from recipes.metrics import performance_profile, probability_of_improvement, stratified_bootstrap_ci

REPS = 4000


@pytest.fixture
def scores():
    scores = np.random.default_rng(3).standard_t(3, size=(40, 3)) + np.array([0.0, 0.3, -0.2])
    assert scores.sum() == pytest.approx(26.237676148704345, abs=1e-9)  # those that rliable was given
    return scores


@pytest.fixture
def other():
    other = np.random.default_rng(4).standard_t(3, size=(25, 3))
    assert other.sum() == pytest.approx(-11.640049123042026, abs=1e-9)
    return other


def test_iqm_and_its_interval_are_those_of_rliable(scores):
    estimate, low, high = stratified_bootstrap_ci(scores, reps=REPS)
    assert estimate == pytest.approx(0.1223252934881252, abs=1e-12)
    np.testing.assert_allclose([low, high], [-0.084300, 0.340119], atol=0.06 * (high - low))


def test_profile_and_its_band_are_those_of_rliable(scores):
    estimate, low, high = performance_profile(scores, np.linspace(-2, 2, 9), reps=REPS)
    above = np.array([117, 112, 101, 85, 69, 41, 27, 10, 7]) / 120
    np.testing.assert_allclose(estimate, above, atol=1e-12)
    band_low = [0.94167, 0.88333, 0.775, 0.625, 0.48333, 0.25833, 0.15, 0.03333, 0.025]
    band_high = [1.0, 0.975, 0.9, 0.78333, 0.66667, 0.43333, 0.3, 0.13333, 0.1]
    np.testing.assert_allclose([low, high], [band_low, band_high], atol=0.012)


def test_probability_of_improvement_and_its_interval_are_those_of_rliable(scores, other):
    estimate, low, high = probability_of_improvement(scores, other, reps=REPS)
    assert estimate == pytest.approx(0.5516666666666666, abs=1e-12)
    np.testing.assert_allclose([low, high], [0.470333, 0.634342], atol=0.012)
