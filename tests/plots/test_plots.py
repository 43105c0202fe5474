"""Figures: what is drawn is what was given, nothing overlaps, and nothing leaks into matplotlib's global state."""

from __future__ import annotations

import itertools
import subprocess
import sys

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchrl_priors.methods import METHODS
from torchrl_priors.metrics import (
    ConfidenceInterval,
    iqm,
    mean_confidence_interval,
    performance_profile,
    stratified_bootstrap_ci,
)
from torchrl_priors.plots import (
    grid_world,
    iqm_bars,
    learning_curves,
    method_color,
    method_label,
    performance_profiles,
    prior_label,
    save_figure,
)

PRIORS = ["expert", "random_15", "random_30", "random_50", "structural_3", "structural_5", "structural_10"]
STEPS = np.arange(1, 31) * 1000


def returns(runs=8, seed=0):
    return np.random.default_rng(seed).normal(size=(runs, len(STEPS))).cumsum(1)


def ratios(runs=30, seed=0):
    return np.random.default_rng(seed).normal(scale=0.3, size=(runs, 2))


def study(methods):
    return {p: {m: returns(seed=i) for i, m in enumerate(methods)} for p in PRIORS}


def world():
    walls, rewards = np.zeros((5, 6), bool), np.zeros((5, 6))
    walls[0, :2] = True
    rewards[1, 1], rewards[2, 2], rewards[4, 5] = 10, -1, -5
    return {"walls": walls, "rewards": rewards, "terminal": np.abs(rewards) > 1, "start": (3, 3)}


def panel(figure, title):
    return next(ax for ax in figure.axes if ax.get_title() == title)


def line(ax, color):
    return next(
        entry for entry in ax.lines if to_rgb(entry.get_color()) == to_rgb(color) and len(entry.get_xdata()) > 2
    )


def overlapping_texts(figure):
    """Pairs of texts whose boxes overlap by more than a pixel, among those that are really drawn."""
    drawn = {}
    draw = Text.draw

    def record(self, renderer, *args, **kwargs):
        if self.get_visible() and self.get_text().strip():
            drawn[self] = self.get_window_extent(renderer)
        return draw(self, renderer, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Text, "draw", record)
        figure.draw_without_rendering()
    return [
        (one.get_text(), other.get_text())
        for (one, a), (other, b) in itertools.combinations(drawn.items(), 2)
        if min(a.x1, b.x1) - max(a.x0, b.x0) > 1 and min(a.y1, b.y1) - max(a.y0, b.y0) > 1
    ]


FIGURES = {
    "paper": lambda: learning_curves(
        study(["er", "e2r", "aer", "ae2r"]),
        baseline=returns(seed=9),
        steps=STEPS,
        profiles={m: ratios(seed=i) for i, m in enumerate(["er", "e2r", "aer", "ae2r"])},
    ),
    "every method": lambda: learning_curves(
        study([m for m in METHODS if m != "none"]),
        baseline=returns(seed=9),
        steps=STEPS,
        profiles={m: ratios(seed=i) for i, m in enumerate(METHODS) if m != "none"},
    ),
    "one panel": lambda: learning_curves({"expert": {"ae2r": returns()}}, steps=STEPS),
    "environments": lambda: learning_curves(
        {f"Env-v{i}": {"ae2r": 1000 * returns()} for i in range(5)},
        baseline={f"Env-v{i}": returns() for i in range(5)},
        steps=100 * STEPS,
        profiles={"ae2r": ratios()},
        share_y=False,
    ),
    "profiles": lambda: performance_profiles({m: ratios() for m in METHODS if m != "none"}),
    "bars": lambda: iqm_bars(
        {p: {m: ratios(seed=i)[:, 0] for i, m in enumerate(METHODS) if m != "none"} for p in PRIORS}
    ),
    "bars of three": lambda: iqm_bars(
        {p: {"ae2r": ratios()[:, 0]} for p in PRIORS[:3]}, reference={"expert": {"ae2r": 0.1}}
    ),
    "world": lambda: grid_world(
        **world(),
        policy=np.ones((5, 6), int),
        prior_weight=np.full((5, 6), 0.3),
        degraded=np.eye(5, 6, dtype=bool),
        title="World 3",
    ),
}


@pytest.mark.parametrize("name", FIGURES)
def test_no_text_overlaps_another(name):
    assert overlapping_texts(FIGURES[name]()) == []


def test_overlap_check_sees_an_overlap():
    figure = Figure()
    figure.text(0.5, 0.5, "one")
    figure.text(0.5, 0.5, "other")
    assert overlapping_texts(figure) == [("one", "other")]


@pytest.mark.parametrize("name", FIGURES)
def test_matplotlib_settings_are_left_alone(name, tmp_path):
    before = dict(mpl.rcParams)
    save_figure(FIGURES[name](), tmp_path / "figure", formats=["png"], dpi=50)
    assert dict(mpl.rcParams) == before


def test_pyplot_is_never_imported():
    code = """
import sys
from torchrl_priors.plots import learning_curves, save_figure
import tempfile
with tempfile.TemporaryDirectory() as folder:
    save_figure(learning_curves({"expert": {"er": [[1.0, 2.0]]}}), folder + "/x")
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


class TestNames:
    def test_every_method_has_a_colour_and_a_label_of_its_own(self):
        assert len({method_color(m) for m in METHODS}) == len({method_label(m) for m in METHODS}) == len(METHODS)

    def test_unknown_method_keeps_its_colour(self):
        assert method_color("mine") == method_color("mine")
        assert method_color("mine") not in {method_color(m) for m in METHODS}

    @pytest.mark.parametrize(
        ("name", "label"),
        [("structural_1", "Structural, 1 state"), ("random_x", "random_x"), ("bad_teacher", "bad_teacher"), ("", "")],
    )
    def test_prior_label(self, name, label):
        assert prior_label(name) == label


class TestLearningCurves:
    def test_line_is_the_mean_and_band_its_pointwise_interval(self):
        curve = returns()
        ax = learning_curves({"expert": {"ae2r": curve}}, steps=STEPS).axes[0]
        mean, low, high = mean_confidence_interval(curve)
        drawn = line(ax, method_color("ae2r"))
        np.testing.assert_array_equal(drawn.get_xdata(), STEPS)
        np.testing.assert_allclose(drawn.get_ydata(), mean)
        band = ax.collections[0].get_paths()[0].vertices
        for x, bottom, top in zip(STEPS, low, high, strict=True):
            ys = band[band[:, 0] == x, 1]
            np.testing.assert_allclose([ys.min(), ys.max()], [bottom, top])

    def test_finished_intervals_are_drawn_as_they_are(self):
        ready = ConfidenceInterval(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.full(3, 5.0))
        ax = learning_curves({"expert": {"er": ready}}).axes[0]
        assert line(ax, method_color("er")).get_ydata().tolist() == [1.0, 2.0, 3.0]
        assert line(ax, method_color("er")).get_xdata().tolist() == [1, 2, 3]

    def test_papers_priors_take_the_papers_places(self):
        figure = FIGURES["paper"]()
        figure.draw_without_rendering()
        rows = [[prior_label(p) for p in PRIORS[:4]], ["Performance profiles", *(prior_label(p) for p in PRIORS[4:])]]
        center = {
            title: (box.x0 + box.width / 2, box.y0)
            for title, box in ((ax.get_title(), ax.get_position()) for ax in figure.axes)
        }
        for row in rows:
            assert sorted(row, key=center.__getitem__) == row  # left to right
        for above, below in zip(*rows, strict=True):
            assert center[above][0] == pytest.approx(center[below][0])
            assert center[above][1] > center[below][1]

    def test_baseline_is_dashed_black_in_every_panel(self):
        figure = FIGURES["paper"]()
        for prior in PRIORS:
            base = line(panel(figure, prior_label(prior)), "black")
            np.testing.assert_allclose(base.get_ydata(), returns(seed=9).mean(0))
            assert base.is_dashed()

    def test_baseline_may_differ_between_environments(self):
        figure = learning_curves(
            {"a": {"er": returns()}, "b": {"er": returns()}}, baseline={"b": returns() + 3}, share_y=False
        )
        assert len(panel(figure, "a").lines) == 1
        np.testing.assert_allclose(line(panel(figure, "b"), "black").get_ydata(), returns().mean(0) + 3)

    def test_legend_names_each_method_once_and_the_baseline(self):
        labels = [text.get_text() for text in FIGURES["paper"]().legends[0].get_texts()]
        assert labels == ["ER", "E2R", "AER", "AE2R", "Baseline"]

    def test_panels_of_one_environment_share_their_scale(self):
        curves = {"expert": {"er": returns()}, "random_15": {"er": 100 * returns()}}
        shared, own = learning_curves(curves), learning_curves(curves, share_y=False)
        assert shared.axes[0].get_ylim() == shared.axes[1].get_ylim()
        assert own.axes[0].get_ylim() != own.axes[1].get_ylim()

    def test_curve_of_other_points_than_steps_is_named(self):
        with pytest.raises(ValueError, match="'er' of 'expert'"):
            learning_curves({"expert": {"er": returns()}}, steps=STEPS[:-1])

    @pytest.mark.parametrize("nothing", [{}, {"expert": {}}])
    def test_nothing_to_draw_is_an_error(self, nothing):
        with pytest.raises(ValueError, match="no curves"):
            learning_curves(nothing)

    def test_arguments_are_not_changed(self):
        curves = {"expert": {"er": returns()}}
        learning_curves(curves, baseline=returns())
        assert list(curves["expert"]) == ["er"]


class TestProfiles:
    def test_line_is_the_profile_and_zero_is_marked(self):
        taus = np.linspace(-0.5, 0.5, 11)
        ax = performance_profiles({"ae2r": ratios()}, taus).axes[0]
        expected = performance_profile(ratios(), taus)
        np.testing.assert_allclose(line(ax, method_color("ae2r")).get_ydata(), expected.estimate)
        zero = next(entry for entry in ax.lines if len(entry.get_xdata()) == 2)
        assert list(zero.get_xdata()) == [0, 0]
        assert zero.is_dashed()

    def test_no_profile_is_an_error(self):
        with pytest.raises(ValueError, match="no profiles"):
            performance_profiles({})

    def test_profile_at_other_thresholds_is_named(self):
        with pytest.raises(ValueError, match="profile of 'er'"):
            performance_profiles({"er": performance_profile(ratios(), [0.0, 1.0])}, [0.0, 0.5, 1.0])


class TestBars:
    def test_bar_spans_the_interval_and_line_is_the_iqm(self):
        scores = ratios()[:, 0]
        ax = iqm_bars({"expert": {"er": scores}}).axes[0]
        _, low, high = stratified_bootstrap_ci(scores)
        bar = ax.patches[0]
        assert (bar.get_x(), bar.get_x() + bar.get_width()) == pytest.approx((1e3 * low, 1e3 * high))
        assert ax.collections[0].get_segments()[0][0, 0] == pytest.approx(1e3 * iqm(scores))

    def test_reference_is_a_marker_beside_its_method(self):
        figure = iqm_bars(
            {"expert": {"er": [0.1, 0.2], "ae2r": [0.3, 0.4]}},
            reference={"expert": {"ae2r": ConfidenceInterval(0.036, 0.025, 0.05)}, "other": {"er": 1.0}},
            reference_label="Published",
        )
        marker = next(entry for entry in figure.axes[0].lines if entry.get_marker() == "D")
        assert (marker.get_xdata()[0], marker.get_ydata()[0]) == (pytest.approx(36), 1)
        assert "Published" in [text.get_text() for text in figure.legends[0].get_texts()]

    @pytest.mark.parametrize("value", [0.5, -0.5])
    def test_zero_and_every_bar_are_in_view(self, value):
        ax = iqm_bars({"expert": {"er": ConfidenceInterval(value, value - 0.1, value + 0.1)}}).axes[0]
        left, right = ax.get_xlim()
        assert left < min(0, 1e3 * (value - 0.1)) < max(0, 1e3 * (value + 0.1)) < right

    def test_method_missing_for_a_prior_leaves_its_row_empty(self):
        figure = iqm_bars({"expert": {"er": [0.1], "ae2r": [0.2]}, "random_15": {"ae2r": [0.3]}})
        bar = figure.axes[1].patches[0]
        assert len(figure.axes[1].patches) == 1
        assert bar.get_y() + bar.get_height() / 2 == pytest.approx(1)

    def test_nothing_to_draw_is_an_error(self):
        with pytest.raises(ValueError, match="no scores"):
            iqm_bars({"expert": {}})


class TestSave:
    def test_same_figure_same_bytes(self, tmp_path):
        one = save_figure(FIGURES["profiles"](), tmp_path / "one", formats=["pdf", "png", "svg"])
        other = save_figure(FIGURES["profiles"](), tmp_path / "other", formats=["pdf", "png", "svg"])
        assert [file.read_bytes() for file in one] == [file.read_bytes() for file in other]

    def test_nothing_but_the_figures_is_left_behind(self, tmp_path):
        written = save_figure(Figure(), tmp_path / "new" / "v1.2")
        assert sorted(tmp_path.rglob("*.*")) == sorted(written)
        assert [file.name for file in written] == ["v1.2.pdf", "v1.2.png"]

    def test_failure_keeps_the_old_file(self, tmp_path):
        (old,) = save_figure(Figure(), tmp_path / "figure", formats=["png"])
        before = old.read_bytes()
        with pytest.raises(ValueError, match="not supported"):
            save_figure(Figure(facecolor="red"), tmp_path / "figure", formats=["nonsense", "png"])
        assert old.read_bytes() == before

    def test_folder_that_cannot_be_made_is_an_error(self, tmp_path):
        (tmp_path / "file").write_text("in the way")
        with pytest.raises(OSError, match="file"):
            save_figure(Figure(), tmp_path / "file" / "figure")

    def test_colours_survive_the_small_png(self, tmp_path):
        from PIL import Image

        (file,) = save_figure(FIGURES["world"](), tmp_path / "world", formats=["png"], dpi=150)
        with Image.open(file) as image:
            pixels = np.asarray(image.convert("RGB"), dtype=int).reshape(-1, 3)
        for color in ("#4C84C4", "#5FB56A", "#C8102E"):
            target = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])
            assert np.abs(pixels - target).max(-1).min() <= 6
