"""Figures of several environments: variants of methods keep apart and in their family."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_hex

from recipes.metrics import ConfidenceInterval
from recipes.plots import curve_panels, interval_panels, method_color, profile_panels
from recipes.plots.variants import variant_label, variant_styles

STEPS = np.arange(1.0, 4.0)
BAND = ConfidenceInterval(STEPS, STEPS - 1, STEPS + 1)
VARIANTS = ["none", "e2r", *(f"ae2r Cω={value}" for value in (1, 0.3, 0.03, 0.003))]


def test_every_variant_has_a_line_of_its_own_and_the_first_its_methods_colour() -> None:
    styles = variant_styles(VARIANTS)
    assert len({(style["color"], str(style["linestyle"])) for style in styles.values()}) == len(VARIANTS)
    assert len({style["color"] for style in styles.values()}) == len(VARIANTS)
    assert [styles[name]["color"] for name in ("e2r", "ae2r Cω=1")] == [
        to_hex(method_color(name)) for name in ("e2r", "ae2r")
    ]


def test_a_legend_names_each_method_once_whatever_panels_it_is_in() -> None:
    panels = {"Hopper": dict.fromkeys(VARIANTS, BAND), "Ant": dict.fromkeys(VARIANTS[:2], BAND)}
    figure = curve_panels(panels, {"Hopper": STEPS, "Ant": STEPS}, baseline="PPO")
    texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert sorted(texts) == sorted(variant_label(name, "PPO") for name in VARIANTS)
    assert "PPO" in texts


def test_curves_are_drawn_where_they_are() -> None:
    (ax,) = curve_panels({"Hopper": {"e2r": BAND}}, {"Hopper": 50 * STEPS}).axes
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xydata(), np.stack([50 * STEPS, STEPS], 1))


def test_a_reference_is_marked_by_name_at_its_level() -> None:
    figure = curve_panels({"Hopper": {"e2r": BAND}}, {"Hopper": STEPS}, references={"Hopper": {"Teacher": 2.5}})
    (ax,) = figure.axes
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["E2R", "Teacher"]
    assert any(set(line.get_ydata()) == {2.5} for line in ax.lines)


def test_a_curve_that_does_not_fit_its_steps_is_named() -> None:
    with pytest.raises(ValueError, match="'e2r' of 'Hopper'"):
        curve_panels({"Hopper": {"e2r": BAND}}, {"Hopper": STEPS[:2]})


@pytest.mark.parametrize("draw", [lambda panels: curve_panels(panels, {}), profile_panels, interval_panels])
def test_nothing_to_draw_is_an_error(draw) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match="nothing to draw"):
        draw({"Hopper": {}})


def test_intervals_hold_the_centre_and_a_row_for_every_method() -> None:
    point = ConfidenceInterval(0.8, 0.8, 0.8)
    figure = interval_panels({"a": {"e2r": point}, "b": {"ae2r": ConfidenceInterval(0.9, 0.7, 1.0)}}, center=0.5)
    for ax in figure.axes:
        low, high = ax.get_xlim()
        assert low < 0.5 < high
        assert list(ax.get_yticks()) == [0, 1]
    assert [tick.get_text() for tick in figure.axes[0].get_yticklabels()] == ["E2R", "AE2R"]


def test_profiles_reach_as_far_as_the_runs_do() -> None:
    figure = profile_panels({"good": {"e2r": np.full((5, 2), 3.9)}}, reps=10)
    assert figure.axes[0].get_xlim() == (-1, 4)
    assert profile_panels({"good": {"e2r": np.full(5, 1e6)}}, reps=10).axes[0].get_xlim()[1] == 10
