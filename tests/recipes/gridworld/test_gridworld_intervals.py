"""The samples of a grid-world study's intervals are its worlds."""

from __future__ import annotations

import numpy as np
import pytest
from omegaconf import OmegaConf

from recipes.gridworld.page import _profile
from recipes.gridworld.tables import Episodes, prior_weight_table
from recipes.gridworld.tabular import LOG_FIELDS


def test_intervals_of_the_prior_weight_are_those_of_worlds():
    cfg = OmegaConf.create(
        {"methods": ["none", "ae2r"], "priors": ["structural_3"], "bootstrap": {"reps": 500, "seed": 0}}
    )
    rng, worlds = np.random.default_rng(0), 50
    episodes = np.zeros((worlds, 2, 20, len(LOG_FIELDS)))
    visits = rng.integers(1, 9, (worlds, 20))
    for group, mean in (("degraded", 0.3), ("other", 0.4)):  # a world's weight is that of all its visits
        episodes[:, 1, :, LOG_FIELDS.index(f"n_{group}")] = visits
        episodes[:, 1, :, LOG_FIELDS.index(f"w_{group}")] = visits * rng.normal(mean, 0.1, (worlds, 1))
    row = prior_weight_table(cfg, Episodes(cfg, episodes)).set_index("average").loc["episode"]
    for name, error in (("degraded", 0.1), ("non_degraded", 0.1), ("gap", 0.1 * 2**0.5)):
        half = (row[f"{name}_ci_high"] - row[f"{name}_ci_low"]) / 2
        assert half == pytest.approx(1.96 * error / worlds**0.5, rel=0.3)


def test_performance_profiles_resample_whole_worlds():
    ratios = np.random.default_rng(0).normal(size=(100, 1)).repeat(7, 1)  # all priors of a world are alike
    band, alone = (_profile(array, np.zeros(1)) for array in (ratios, ratios[:, :1]))
    assert (band.high - band.low)[0] == pytest.approx((alone.high - alone.low)[0])
