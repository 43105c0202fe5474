"""Figures and videos of prior weights: what is drawn, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from recipes.plots import episode_weights, weight_curves, weight_maps
from recipes.plots.video import write_weight_video

GRID = np.zeros((3, 4))
WORLD = {"walls": GRID, "rewards": GRID, "terminal": GRID, "start": (1, 1)}
MEANS = {"steps": [10, 20], "over_degraded": [0.5, 0.25], "over_other": [0.5, 0.75]}


def test_every_map_is_drawn_beside_the_means():
    degraded = GRID.astype(bool)
    degraded[0, 1] = True
    figure = weight_maps(WORLD, {"Early": GRID + 0.5, "Late": GRID + 0.9}, degraded, **MEANS)
    assert [ax.get_title() for ax in figure.axes[:3]] == ["Early", "Late", ""]
    lines = {line.get_label(): list(line.get_ydata()) for line in figure.axes[2].lines}
    assert lines == {"Other states": [0.5, 0.75], "Degraded states": [0.5, 0.25]}
    hatched = [[patch for patch in ax.patches if patch.get_hatch()] for ax in figure.axes[:2]]
    assert [len(patches) for patches in hatched] == [1, 1]


def test_a_prior_without_degraded_states_has_no_curve_of_them():
    figure = weight_maps(WORLD, {"": GRID}, GRID, **{**MEANS, "over_degraded": [np.nan, np.nan]})
    assert [line.get_label() for line in figure.axes[1].lines] == ["Other states"]


def test_curves_have_a_panel_per_prior_and_two_lines_per_method():
    pair = ([0.5, 0.3], [0.5, 0.6])
    figure = weight_curves({"structural_3": {"ae2r": pair, "aligned": pair}, "structural_5": {"ae2r": pair}}, [1, 2])
    assert [len(ax.lines) for ax in figure.axes] == [4, 2]
    assert figure.axes[0].lines[0].get_linestyle() == "--"  # degraded states


def test_steps_with_degraded_advice_are_shaded_in_every_panel():
    figure = episode_weights(
        [0.1, 0.2, 0.3, 0.4], [-1.0] * 4, [0.0] * 4, method="ae2r", degraded=[False, True, True, False]
    )
    for ax in figure.axes:
        (span,) = ax.patches
        assert span.get_x() == 0.5
        assert span.get_width() == 2.0
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[-1] == "mean 0.25 there, 0.25 elsewhere"


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="at least one map"):
        weight_maps(WORLD, {}, GRID, **MEANS)
    with pytest.raises(ValueError, match=r"one shape \[N\]"):
        weight_maps(WORLD, {"": GRID}, GRID, **{**MEANS, "steps": [1]})
    with pytest.raises(ValueError, match="at least one curve"):
        weight_curves({}, [1])
    with pytest.raises(ValueError, match="structural_3, ae2r"):
        weight_curves({"structural_3": {"ae2r": ([0.1], [0.1])}}, [1, 2])
    with pytest.raises(ValueError, match=r"one shape \[T\]"):
        episode_weights([0.1], [0.1, 0.2], [0.1], method="ae2r")
    with pytest.raises(ValueError, match="2 frames and 1 weights"):
        write_weight_video("never.gif", [GRID, GRID], [0.1], rate=10)


def test_a_video_shows_the_weight_and_leaves_frames_out_where_there_are_too_many(tmp_path):
    frames = [np.zeros((60, 60, 3), np.uint8)] * 8
    file = write_weight_video(tmp_path / "a.gif", frames, np.linspace(0, 1, 8), [True] + [False] * 7, rate=50)
    with Image.open(file) as video:
        assert video.n_frames == 4  # of 50 a second every other
        assert video.info["duration"] == 40
        first = np.asarray(video.convert("RGB"), int)
        video.seek(3)
        last = np.asarray(video.convert("RGB"), int)
    assert first.shape == (78, 60, 3)
    red = first[0, 30]
    assert red[0] > 150
    assert red[1] < 60
    assert last[0, 30].max() < 60  # no frame
    assert list(tmp_path.iterdir()) == [file]
