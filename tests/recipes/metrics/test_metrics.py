"""Metrics against numbers worked out by hand, properties, and the reference implementation (rliable)."""

# ruff: noqa: NPY002  (the global generator is what is tested, or the only one that the reference listens to)

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recipes.metrics import (
    RATIO_LIMIT,
    area_ratio,
    area_under_curve,
    iqm,
    mean_confidence_interval,
    performance_profile,
    probability_of_improvement,
    share_of_runs,
    stratified_bootstrap_ci,
)

moderate = st.floats(-1e3, 1e3, allow_subnormal=False)


samples = hnp.arrays(np.float64, st.integers(1, 40), elements=moderate)


matrices = hnp.arrays(np.float64, st.tuples(st.integers(1, 15), st.integers(1, 4)), elements=moderate)


class TestArea:
    def test_area_is_the_mean_of_the_curve(self):
        np.testing.assert_allclose(
            area_under_curve(np.arange(24.0).reshape(2, 3, 4)), [[1.5, 5.5, 9.5], [13.5, 17.5, 21.5]]
        )

    def test_area_does_not_depend_on_the_number_of_evaluations_of_a_constant_curve(self):
        assert area_under_curve([7.0] * 3) == area_under_curve([7.0] * 100) == 7.0

    @pytest.mark.parametrize(
        ("with_prior", "baseline", "ratio"),
        [
            (3.0, 2.0, 0.5),
            (1.0, 2.0, -0.5),
            (0.0, 0.0, 0.0),
            (2.0, 0.0, RATIO_LIMIT),
            (-2.0, 0.0, -RATIO_LIMIT),
            (2.0, -1.0, -3.0),  # the formula as it stands
            (1.0, 1e-9, RATIO_LIMIT),  # never beyond what stands for infinity
            (1.0, 5e-324, RATIO_LIMIT),
            (-1.0, 1e-300, -RATIO_LIMIT),
        ],
    )
    def test_ratio_is_that_worked_out_by_hand(self, with_prior, baseline, ratio):
        assert area_ratio(with_prior, baseline) == pytest.approx(ratio)

    def test_limit_of_the_ratio_is_a_setting(self):
        assert area_ratio(1.0, 0.0, limit=10.0) == 10.0

    def test_ratio_broadcasts_a_baseline_over_methods(self):
        np.testing.assert_allclose(area_ratio([[2.0, 4.0], [3.0, 2.0]], [2.0, 4.0]), [[0.0, 0.0], [0.5, -0.5]])

    @given(st.floats(-1e3, 1e3), st.floats(0.01, 1e3), st.floats(0.01, 100))
    def test_ratio_does_not_depend_on_the_unit_of_the_return(self, with_prior, baseline, unit):
        assert area_ratio(with_prior * unit, baseline * unit) == pytest.approx(
            area_ratio(with_prior, baseline), abs=1e-9
        )


class TestIQM:
    @pytest.mark.parametrize(
        ("scores", "expected"),
        [([5.0], 5.0), ([1.0, 2.0, 6.0], 3.0), ([9.0, 1.0, 2.0, 4.0], 3.0), (range(8), 3.5), ([0, 0, 0, 0, 100], 0.0)],
    )
    def test_iqm_is_that_worked_out_by_hand(self, scores, expected):
        assert iqm(scores) == expected

    @given(samples, st.randoms(use_true_random=False))
    def test_order_of_the_runs_does_not_matter(self, scores, random):
        shuffled = scores.tolist()
        random.shuffle(shuffled)
        assert iqm(shuffled) == pytest.approx(iqm(scores), abs=1e-9)

    @given(samples, st.floats(-100, 100), st.floats(-10, 10))
    def test_iqm_is_affine_equivariant(self, scores, shift, scale):
        assert iqm(scale * scores + shift) == pytest.approx(scale * iqm(scores) + shift, abs=1e-6)

    @given(hnp.arrays(np.float64, st.integers(4, 40), elements=moderate), st.floats(1e4, 1e12))
    def test_one_outlier_moves_it_only_within_the_other_scores(self, scores, outlier):
        moved = scores.copy()
        moved[0] = outlier
        assert scores[1:].min() - 1e-9 <= iqm(moved) <= scores[1:].max() + 1e-9

    @given(matrices)
    def test_along_an_axis_is_that_of_each_slice(self, scores):
        np.testing.assert_allclose(iqm(scores, axis=0), [iqm(column) for column in scores.T], atol=1e-9)
        np.testing.assert_allclose(iqm(scores, axis=-1), [iqm(row) for row in scores], atol=1e-9)

    def test_iqm_does_not_change_its_input(self):
        scores = np.array([3.0, 1.0, 2.0, 0.0])
        iqm(scores)
        assert scores.tolist() == [3.0, 1.0, 2.0, 0.0]


class TestMeanInterval:
    def test_interval_of_a_mean_is_1_96_standard_errors_wide(self):
        scores = np.random.default_rng(0).normal(size=(50, 3))
        mean, low, high = mean_confidence_interval(scores)
        sem = scores.std(0, ddof=1) / np.sqrt(50)
        np.testing.assert_allclose(low, mean - 1.96 * sem, rtol=1e-3)
        np.testing.assert_allclose(high, mean + 1.96 * sem, rtol=1e-3)

    def test_of_a_single_run_is_a_point(self):
        assert mean_confidence_interval([[1.0, 2.0]], axis=0).low.tolist() == [1.0, 2.0]


class TestBootstrap:
    def test_same_seed_same_interval_whatever_was_drawn_before(self):
        scores = np.random.default_rng(0).normal(size=(30, 3))
        first = stratified_bootstrap_ci(scores, seed=5)
        np.random.rand(7)
        assert stratified_bootstrap_ci(scores, seed=5) == first
        assert stratified_bootstrap_ci(scores, seed=6) != first

    def test_global_random_state_is_left_alone(self):
        np.random.seed(1)
        before = np.random.get_state()[1].tolist()
        stratified_bootstrap_ci(np.arange(10.0))
        performance_profile(np.arange(10.0), [3.0])
        probability_of_improvement(np.arange(10.0), np.arange(10.0))
        assert np.random.get_state()[1].tolist() == before

    @given(matrices, st.integers(0, 10))
    def test_interval_lies_within_the_scores_and_is_ordered(self, scores, seed):
        _, low, high = stratified_bootstrap_ci(scores, np.mean, reps=20, seed=seed)
        assert scores.min() - 1e-9 <= low <= high <= scores.max() + 1e-9

    def test_tasks_are_strata(self):
        # were runs drawn across tasks, the mean would vary; within tasks nothing can
        scores = np.tile([0.0, 100.0], (10, 1))
        assert stratified_bootstrap_ci(scores, np.mean) == (50.0, 50.0, 50.0)

    def test_runs_are_resampled_whole_along_the_trailing_dimensions(self):
        scores = np.random.default_rng(0).normal(size=20)
        paired = np.stack([scores + 1.0, scores], -1)[:, None]

        def gap(sample, axis):
            return np.subtract(*np.moveaxis(np.mean(sample, axis=axis), -1, 0))

        np.testing.assert_allclose(stratified_bootstrap_ci(paired, gap), [1.0, 1.0, 1.0])

    def test_curves_get_a_band_per_point(self):
        curves = np.random.default_rng(0).normal(size=(12, 2, 5))
        estimate, low, high = stratified_bootstrap_ci(curves, reps=300)
        assert estimate.shape == low.shape == high.shape == (5,)
        np.testing.assert_allclose(estimate, [iqm(curves[..., point]) for point in range(5)])

    def test_interval_is_the_same_when_drawn_in_several_chunks(self, monkeypatch):
        scores = np.random.default_rng(0).normal(size=(13, 2))
        whole = (
            stratified_bootstrap_ci(scores, reps=101),
            probability_of_improvement(scores, scores[:7] + 0.1, reps=101),
        )
        for module in ("bootstrap", "comparison"):
            monkeypatch.setattr(f"recipes.metrics.{module}.CHUNK", 26 * 40)
        np.testing.assert_allclose(stratified_bootstrap_ci(scores, reps=101), whole[0])
        chunked = probability_of_improvement(scores, scores[:7] + 0.1, reps=101)
        np.testing.assert_allclose(chunked, whole[1], atol=0.05)  # two draws a chunk: another order, the same law

    def test_coverage_is_near_nominal(self):
        rng = np.random.default_rng(0)
        hits = 0
        for _ in range(300):
            _, low, high = stratified_bootstrap_ci(rng.normal(size=60), np.mean, reps=300, seed=rng, confidence=0.9)
            hits += low <= 0.0 <= high
        assert 0.83 < hits / 300 < 0.95  # 0.9 less the bootstrap's small-sample shortfall, +- 3 sigma

    def test_more_confidence_is_a_wider_interval(self):
        scores = np.random.default_rng(0).normal(size=50)
        narrow, wide = (stratified_bootstrap_ci(scores, confidence=c) for c in (0.5, 0.99))
        assert wide.low < narrow.low < narrow.high < wide.high


class TestProfile:
    def test_profile_is_that_worked_out_by_hand(self):
        profile = performance_profile([[0.0, 1.0], [2.0, 3.0]], [-1.0, 0.0, 1.5, 3.0])
        assert profile.estimate.tolist() == [1.0, 0.75, 0.5, 0.0]

    def test_thresholds_may_come_in_any_order(self):
        scores = np.random.default_rng(0).normal(size=(30, 2))
        taus = np.linspace(-2, 2, 9)
        shuffle = np.random.default_rng(1).permutation(9)
        straight, shuffled = performance_profile(scores, taus), performance_profile(scores, taus[shuffle])
        for one, other in zip(straight, shuffled, strict=True):
            np.testing.assert_allclose(one[shuffle], other)

    @given(matrices, hnp.arrays(np.float64, st.integers(1, 10), elements=moderate))
    def test_falls_from_one_to_zero_within_its_band(self, scores, taus):
        taus = np.sort(taus)
        estimate, low, high = performance_profile(scores, taus, reps=50)
        expected = [(scores > tau).mean() for tau in taus]
        np.testing.assert_allclose(estimate, expected)
        assert (np.diff(estimate) <= 0).all()
        assert (low <= high).all()
        assert ((low >= 0) & (high <= 1)).all()

    def test_band_is_the_bootstrap_of_the_share_above(self):
        scores = np.random.default_rng(0).normal(size=(40, 3))
        for tau in (-0.5, 0.0, 1.0):
            direct = stratified_bootstrap_ci(scores > tau, np.mean, reps=20_000)
            profile = performance_profile(scores, [tau], reps=20_000)
            np.testing.assert_allclose([profile.low[0], profile.high[0]], direct[1:], atol=0.01)


class TestProbabilityOfImprovement:
    def test_probability_is_that_worked_out_by_hand(self):
        # task 1: pairs 1>0, 1<2, 3>0, 3>2 -> 3/4; task 2: 0=0, 0<5, 5>0, 5=5 -> 2/4
        x, y = [[1.0, 0.0], [3.0, 5.0]], [[0.0, 0.0], [2.0, 5.0]]
        assert probability_of_improvement(x, y).estimate == 0.625
        assert probability_of_improvement(x, y, paired=True).estimate == 0.75  # wins, draw, win, draw

    def test_improvement_is_certain_where_every_run_wins(self):
        assert probability_of_improvement([3.0, 4.0], [1.0, 2.0, 2.5]) == (1.0, 1.0, 1.0)

    @given(matrices, st.integers(1, 9), st.booleans())
    def test_the_two_directions_add_to_one(self, x, runs, paired):
        y = np.resize(x[::-1] + 1.0, x.shape if paired else (runs, x.shape[1]))
        there = probability_of_improvement(x, y, paired=paired, reps=5)
        back = probability_of_improvement(y, x, paired=paired, reps=5)
        assert there.estimate + back.estimate == pytest.approx(1.0)

    def test_pairing_sees_through_the_spread_of_the_worlds(self):
        rng = np.random.default_rng(0)
        world = rng.normal(scale=10, size=100)
        better = world + rng.normal(0.5, 0.1, size=100)
        assert probability_of_improvement(better, world, paired=True).low > 0.9
        assert probability_of_improvement(better, world).low < 0.5

    def test_paired_runs_must_match(self):
        with pytest.raises(ValueError, match="equal shapes"):
            probability_of_improvement([1.0, 2.0], [1.0], paired=True)

    def test_tasks_must_match(self):
        with pytest.raises(ValueError, match="same tasks"):
            probability_of_improvement(np.ones((3, 2)), np.ones((3, 4)))


@pytest.mark.parametrize(
    "call",
    [
        iqm,
        area_under_curve,
        mean_confidence_interval,
        stratified_bootstrap_ci,
        lambda x: area_ratio(x, 1.0),
        lambda x: area_ratio(1.0, x),
        lambda x: performance_profile(x, [0.0]),
        lambda x: performance_profile([0.0], x),
        lambda x: probability_of_improvement(x, [1.0]),
        lambda x: probability_of_improvement([1.0], x, paired=True),
    ],
)
@pytest.mark.parametrize(("bad", "message"), [([], "empty"), ([1.0, float("nan")], "1 NaN or infinite values among 2")])
def test_nothing_is_computed_from_bad_scores(call, bad, message):
    with pytest.raises(ValueError, match=message):
        call(bad)


@pytest.mark.parametrize("call", [area_under_curve, mean_confidence_interval, stratified_bootstrap_ci])
def test_single_number_is_refused_where_runs_are_needed(call):
    with pytest.raises(ValueError, match="single number"):
        call(1.0)


@pytest.mark.parametrize(("setting", "message"), [({"confidence": 95}, "confidence"), ({"reps": 0}, "reps")])
def test_settings_out_of_range_are_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        stratified_bootstrap_ci([1.0, 2.0], **setting)


def test_tensors_are_scores_too():
    scores = torch.tensor([[1.0, 2.0], [3.0, 5.0]], requires_grad=True)
    assert iqm(scores) == iqm(scores.tolist())
    assert area_ratio(scores[0], scores[1].detach()).shape == (2,)


class TestShares:
    @pytest.mark.parametrize(
        ("count", "runs", "low", "high"),
        [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (1, 10, 0.0179, 0.4042), (81, 263, 0.2553, 0.3662)],
    )
    def test_interval_is_that_of_wilson(self, count, runs, low, high):
        """The last is an example that Newcombe (1998) works out."""
        found = share_of_runs([True] * count + [False] * (runs - count))
        assert found == pytest.approx((count / runs, low, high), abs=5e-5)

    @given(st.lists(st.booleans(), min_size=1, max_size=60), st.floats(0.01, 0.99))
    def test_ends_solve_the_equation_that_defines_them(self, hits, confidence):
        share, low, high = share_of_runs(hits, confidence=confidence)
        z = NormalDist().inv_cdf((1 + confidence) / 2)
        for end in (low, high):
            assert (share - end) ** 2 == pytest.approx(z**2 * end * (1 - end) / len(hits), abs=1e-9)
        assert low <= share <= high

    def test_runs_in_two_dimensions_are_refused(self):
        with pytest.raises(ValueError, match=r"Expected hits \[runs\], got \(2, 1\)"):
            share_of_runs([[True], [False]])
