"""Figures: what is drawn is what was given, nothing overlaps, and nothing leaks into matplotlib's global state."""

from __future__ import annotations

import itertools

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from recipes.metrics import (
    ConfidenceInterval,
    mean_confidence_interval,
    performance_profile,
    stratified_bootstrap_ci,
)
from recipes.plots import (
    curve_panels,
    grid_world,
    interval_panels,
    method_color,
    method_label,
    prior_label,
    profile_panels,
    save_figure,
    style,
)
from torchrl_priors.methods import METHODS, MethodSpec

PRIORS = ["expert", "random_15", "random_30", "random_50", "structural_3", "structural_5", "structural_10"]
STEPS = np.arange(1, 31) * 1000


def returns(runs=8, seed=0):
    return np.random.default_rng(seed).normal(size=(runs, len(STEPS))).cumsum(1)


def ratios(runs=30, seed=0):
    return np.random.default_rng(seed).normal(scale=0.3, size=(runs, 2))


def bands(methods):
    return {m: mean_confidence_interval(returns(seed=i)) for i, m in enumerate(methods)}


def intervals(methods):
    return {m: stratified_bootstrap_ci(ratios(seed=i)[:, 0], reps=50) for i, m in enumerate(methods)}


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


LEARNERS = [m for m in METHODS if m != "none"]
PLACES = {prior: (i // 4, i % 4 + (i > 3)) for i, prior in enumerate(PRIORS)}
FIGURES = {
    "curves": lambda: curve_panels(
        {prior_label(p): bands(METHODS) for p in PRIORS},
        {prior_label(p): STEPS for p in PRIORS},
        places={prior_label(p): place for p, place in PLACES.items()},
        share_y=True,
    ),
    "one panel": lambda: curve_panels({"Hopper": bands(["ae2r"])}, {"Hopper": STEPS}),
    "environments": lambda: curve_panels(
        {f"Env-v{i}": bands(["none", "ae2r"]) for i in range(5)}, {f"Env-v{i}": 100 * STEPS for i in range(5)}
    ),
    "profiles": lambda: profile_panels({"All priors": {m: ratios() for m in LEARNERS}}, reps=20),
    "bars": lambda: interval_panels({prior_label(p): intervals(LEARNERS) for p in PRIORS}, columns=4),
    "bars with a reference": lambda: interval_panels(
        {p: intervals(["ae2r"]) for p in PRIORS[:3]}, reference={"expert": intervals(["ae2r"])}
    ),
    "world": lambda: grid_world(
        **world(),
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


class TestNames:
    def test_every_method_has_a_colour_and_a_label_of_its_own(self):
        assert len({method_color(m) for m in METHODS}) == len({method_label(m) for m in METHODS}) == len(METHODS)

    def test_a_preset_without_a_label_is_called_by_its_name(self, monkeypatch):
        monkeypatch.setitem(style._METHODS, "mine", (MethodSpec("none", auxiliary=True, adaptive=False).label, ""))
        assert method_label("mine") == "mine"
        assert to_rgb(method_color("mine"))

    def test_unknown_method_keeps_its_colour(self):
        assert method_color("mine") == method_color("mine")
        assert method_color("mine") not in {method_color(m) for m in METHODS}

    @pytest.mark.parametrize(
        ("name", "label"),
        [("structural_1", "Structural, 1 state"), ("random_x", "random_x"), ("bad_teacher", "bad_teacher"), ("", "")],
    )
    def test_a_prior_is_labelled_by_its_kind_and_amount(self, name, label):
        assert prior_label(name) == label


class TestCurves:
    def test_line_and_band_are_what_was_given(self):
        mean, low, high = band = mean_confidence_interval(returns())
        ax = curve_panels({"Hopper": {"ae2r": band}}, {"Hopper": STEPS}).axes[0]
        drawn = line(ax, method_color("ae2r"))
        np.testing.assert_array_equal(drawn.get_xdata(), STEPS)
        np.testing.assert_allclose(drawn.get_ydata(), mean)
        edges = ax.collections[0].get_paths()[0].vertices
        for x, bottom, top in zip(STEPS, low, high, strict=True):
            ys = edges[edges[:, 0] == x, 1]
            np.testing.assert_allclose([ys.min(), ys.max()], [bottom, top])

    def test_an_interval_that_is_not_known_is_not_drawn(self):
        mean, nothing = returns().mean(0), np.full(len(STEPS), np.nan)
        unknown = ConfidenceInterval(mean, nothing, nothing)
        ax = curve_panels({"Hopper": {"er": unknown}}, {"Hopper": STEPS}).axes[0]
        np.testing.assert_allclose(line(ax, method_color("er")).get_ydata(), mean)
        assert not [path for entry in ax.collections for path in entry.get_paths() if len(path.vertices)]

    def test_panels_are_where_they_are_placed(self):
        figure = FIGURES["curves"]()
        figure.draw_without_rendering()
        for one, other in itertools.combinations(PRIORS, 2):
            (row, column), (other_row, other_column) = PLACES[one], PLACES[other]
            a, b = (panel(figure, prior_label(name)).get_position() for name in (one, other))
            assert (a.y0 > b.y0 + 0.1) == (row < other_row)
            assert (a.x0 < b.x0 - 0.1) == (column < other_column)

    def test_the_baseline_is_dashed_and_black(self):
        figure = FIGURES["environments"]()
        base = line(panel(figure, "Env-v3"), "black")
        np.testing.assert_allclose(base.get_ydata(), returns().mean(0))
        assert base.is_dashed()

    def test_panels_of_one_environment_share_their_scale(self):
        band = mean_confidence_interval(returns())
        panels = {"a": {"er": band}, "b": {"er": ConfidenceInterval(*(100 * values for values in band))}}
        steps = {"a": STEPS, "b": STEPS}
        shared, own = curve_panels(panels, steps, share_y=True), curve_panels(panels, steps)
        assert shared.axes[0].get_ylim() == shared.axes[1].get_ylim()
        assert own.axes[0].get_ylim() != own.axes[1].get_ylim()


class TestProfiles:
    def test_line_is_the_profile_and_zero_is_marked(self):
        taus = np.linspace(-0.5, 0.5, 11)
        ax = profile_panels({"All": {"ae2r": ratios()}}, taus, reps=20).axes[0]
        expected = performance_profile(ratios(), taus, reps=20)
        np.testing.assert_allclose(line(ax, method_color("ae2r")).get_ydata(), expected.estimate)
        zero = next(entry for entry in ax.lines if len(entry.get_xdata()) == 2)
        assert list(zero.get_xdata()) == [0, 0]
        assert zero.is_dashed()

    def test_there_is_no_band_of_three_runs(self):
        def height(runs):
            ax = profile_panels({"All": {"er": ratios(runs)}}, reps=20).axes[0]
            vertices = ax.collections[0].get_paths()[0].vertices
            return max(np.ptp(vertices[vertices[:, 0] == x, 1]) for x in np.unique(vertices[:, 0]))

        assert height(3) == 0 < height(4)


class TestIntervals:
    def test_bar_spans_the_interval_and_line_is_the_estimate(self):
        ax = interval_panels({"expert": {"er": ConfidenceInterval(0.2, 0.1, 0.4)}}, scale=1e3).axes[0]
        bar = ax.patches[0]
        assert (bar.get_x(), bar.get_x() + bar.get_width()) == pytest.approx((100, 400))
        assert ax.collections[0].get_segments()[0][0, 0] == pytest.approx(200)

    def test_reference_is_a_marker_beside_its_method(self):
        figure = interval_panels(
            {"expert": {"er": ConfidenceInterval(0.1, 0.0, 0.2), "ae2r": ConfidenceInterval(0.3, 0.2, 0.4)}},
            reference={"expert": {"ae2r": ConfidenceInterval(0.036, 0.025, 0.05)}, "other": {}},
            scale=1e3,
        )
        marker = next(entry for entry in figure.axes[0].lines if entry.get_marker() == "D")
        assert (marker.get_xdata()[0], marker.get_ydata()[0]) == (pytest.approx(36), 1)
        assert "Paper" in [text.get_text() for text in figure.legends[0].get_texts()]

    @pytest.mark.parametrize("value", [0.5, -0.5])
    def test_zero_and_every_bar_are_in_view(self, value):
        ax = interval_panels({"expert": {"er": ConfidenceInterval(value, value - 0.1, value + 0.1)}}).axes[0]
        left, right = ax.get_xlim()
        assert left < min(0, value - 0.1) < max(0, value + 0.1) < right

    def test_method_missing_for_a_prior_leaves_its_row_empty(self):
        one = ConfidenceInterval(0.1, 0.0, 0.2)
        figure = interval_panels({"expert": {"er": one, "ae2r": one}, "random_15": {"ae2r": one}})
        bar = figure.axes[1].patches[0]
        assert len(figure.axes[1].patches) == 1
        assert bar.get_y() + bar.get_height() / 2 == pytest.approx(1)


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
