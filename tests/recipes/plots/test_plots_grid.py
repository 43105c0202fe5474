"""Maps of grid worlds show the walls, rewards and weights that were given."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from test_plots import world

from recipes.plots import grid_world


class TestGridWorld:
    def test_colours_are_the_papers(self):
        image = grid_world(**world()).axes[0].images[0].get_array()
        blue, black, green, white = image[3, 3], image[0, 0], image[1, 1], image[2, 2]
        assert blue.argmax() == 2
        assert black.max() < 0.1
        assert green.argmax() == 1
        assert white.min() == 1

    def test_rewards_are_printed_on_their_cells(self):
        texts = {text.get_text(): text.get_position() for text in grid_world(**world()).axes[0].texts}
        assert set(texts) == {"10", "−1", "−5"}  # noqa: RUF001
        assert [int(x) for x in texts["10"]] == [1, 1]
        assert [int(x) for x in texts["−5"]] == [5, 4]  # noqa: RUF001

    def test_row_zero_is_at_the_top(self):
        bottom, top = grid_world(**world()).axes[0].get_ylim()
        assert (bottom, top) == (5, 0)

    def test_only_free_cells_are_marked_as_degraded(self):
        patches = grid_world(**world(), degraded=np.ones((5, 6))).axes[0].patches
        free = 30 - 2 - 2  # walls, terminals
        assert sum(isinstance(patch, Rectangle) and bool(patch.get_hatch()) for patch in patches) == free

    def test_larger_weights_are_darker_and_unknown_ones_white(self):
        weight = np.full((5, 6), np.nan)
        weight[3, 0], weight[3, 1], weight[3, 2] = 0.0, 0.5, 1.0
        image = grid_world(**world(), prior_weight=weight).axes[0].images[0].get_array()
        brightness = image[3].mean(-1)
        assert brightness[4] == 1 > brightness[0] > brightness[1] > brightness[2]

    def test_a_grid_world_is_drawn_into_given_axes(self):
        figure = Figure()
        first, second = figure.subplots(1, 2)
        assert grid_world(**world(), ax=second) is figure
        assert not first.images
        assert second.images
        assert not figure.legends

    def test_tensors_are_maps_too(self):
        maps = {name: torch.as_tensor(value) if name != "start" else value for name, value in world().items()}
        assert len(grid_world(**maps).axes[0].texts) == 3

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"rewards": np.zeros((6, 5))}, r"rewards has shape \(6, 5\)"),
            ({"terminal": np.zeros(30)}, r"terminal needs the shape \[H, W\]"),
            ({"prior_weight": np.full((5, 6), 1.5)}, "outside"),
            ({"degraded": np.zeros((1, 6))}, "degraded has shape"),
            ({"start": (0, 0)}, "in a wall"),
            ({"start": (5, 0)}, "outside"),
        ],
    )
    def test_maps_that_do_not_fit_are_refused(self, change, message):
        with pytest.raises(ValueError, match=message):
            grid_world(**{**world(), **change})
