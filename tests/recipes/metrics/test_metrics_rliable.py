"""Metrics against the reference implementation (rliable)."""

# ruff: noqa: NPY002  (the global generator is what is tested, or the only one that the reference listens to)

from __future__ import annotations

import numpy as np
import pytest

from recipes.metrics import performance_profile, probability_of_improvement, stratified_bootstrap_ci


class TestAgainstRliable:
    """The reference draws from the global state and doesn't listen to its own seed, so intervals agree in law only."""

    REPS = 4000

    @pytest.fixture
    def scores(self):
        return np.random.default_rng(3).standard_t(3, size=(40, 3)) + np.array([0.0, 0.3, -0.2])

    @pytest.fixture
    def other(self):
        return np.random.default_rng(4).standard_t(3, size=(25, 3))

    @pytest.fixture
    def reference(self):
        pytest.importorskip("rliable")
        from rliable import library, metrics

        np.random.seed(0)
        return library, metrics

    def test_iqm_and_its_interval_are_those_of_rliable(self, scores, reference):
        library, metrics = reference
        point, interval = library.get_interval_estimates(
            {"x": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=self.REPS
        )
        estimate, low, high = stratified_bootstrap_ci(scores, reps=self.REPS)
        assert estimate == pytest.approx(point["x"][0], abs=1e-12)
        np.testing.assert_allclose([low, high], interval["x"][:, 0], atol=0.06 * (high - low))

    def test_profile_and_its_band_are_those_of_rliable(self, scores, reference):
        library, _ = reference
        taus = np.linspace(-2, 2, 9)
        profiles, bands = library.create_performance_profile({"x": scores}, taus, reps=self.REPS)
        estimate, low, high = performance_profile(scores, taus, reps=self.REPS)
        np.testing.assert_allclose(estimate, profiles["x"], atol=1e-12)
        np.testing.assert_allclose([low, high], bands["x"], atol=0.012)

    def test_probability_of_improvement_and_its_interval(self, scores, other, reference):
        library, metrics = reference
        point, interval = library.get_interval_estimates(
            {"x,y": [scores, other]}, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]), reps=1000
        )
        estimate, low, high = probability_of_improvement(scores, other, reps=self.REPS)
        assert estimate == pytest.approx(point["x,y"][0], abs=1e-12)
        np.testing.assert_allclose([low, high], interval["x,y"][:, 0], atol=0.012)
