"""From the evaluation episodes of a gridworld study to its tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from recipes.gridworld.config import GridworldConfig
from recipes.gridworld.run_parts import runs_of
from recipes.gridworld.tabular import LOG_FIELDS
from recipes.metrics import (
    area_ratio,
    area_under_curve,
    iqm,
    mean_confidence_interval,
    stratified_bootstrap_ci,
)
from torchrl_priors.methods import get_method

__all__ = ["Episodes", "tables_of"]

#: What the paper reports.
_PAPER = Path(__file__).with_name("paper_area_ratio.csv")
#: Pairs of methods worth a direct comparison on the same worlds.
_COMPARISONS = (
    ("aer", "er"),
    ("ae2r", "e2r"),
    ("aligned", "ae2r"),
    ("aligned", "kickstart"),
    ("kickstart", "e2r"),
    ("aligned", "annealed_kickstart"),
    ("aligned", "kl_penalty"),
    ("ae2r", "annealed_kickstart"),
    ("ae2r", "kl_penalty"),
    ("pull", "annealed_kickstart"),
    ("pull", "aligned"),
    ("pull", "ae2r"),
)


class Episodes:
    """Evaluation episodes ``[worlds, pairs, points, fields]``, by method, prior and field."""

    def __init__(self, cfg: GridworldConfig, episodes: np.ndarray) -> None:
        self.pairs = runs_of(cfg.methods, cfg.priors)
        self.episodes = episodes
        self.baseline = area_under_curve(self.of("none", "", "return"))

    def of(self, method: str, prior: str, field: str) -> np.ndarray:
        """One field of a pair's episodes, ``[worlds, points]``, in float64."""
        values = self.episodes[:, self.pairs.index((method, prior)), :, LOG_FIELDS.index(field)]
        return values.astype(np.float64)

    def ratio(self, method: str, prior: str) -> np.ndarray:
        """Area ratio of a pair in each world."""
        return area_ratio(area_under_curve(self.of(method, prior, "return")), self.baseline)


def area_ratio_table(cfg: GridworldConfig, data: Episodes) -> pd.DataFrame:
    """IQM of the area ratio and its interval for each prior and method, and what the paper reports."""
    rows = []
    for prior in cfg.priors:
        for method in cfg.methods:
            if method != "none":
                interval = stratified_bootstrap_ci(
                    data.ratio(method, prior), reps=cfg.bootstrap.reps, seed=cfg.bootstrap.seed
                )
                rows.append((prior, method, *interval))
    table = pd.DataFrame(rows, columns=["prior", "method", "iqm", "ci_low", "ci_high"])
    paper = pd.read_csv(_PAPER).rename(columns=lambda name: name if name in ("prior", "method") else f"paper_{name}")
    return table.merge(paper, on=["prior", "method"], how="left")


def comparison_table(cfg: GridworldConfig, data: Episodes) -> pd.DataFrame:
    """Difference of the IQMs of two methods on the same worlds, with a paired bootstrap interval."""
    rows = []
    for method, reference in _COMPARISONS:
        if method in cfg.methods and reference in cfg.methods:
            for prior in cfg.priors:
                both = np.stack([data.ratio(method, prior), data.ratio(reference, prior)], -1)[:, None]
                interval = stratified_bootstrap_ci(
                    both, _difference_of_iqms, reps=cfg.bootstrap.reps, seed=cfg.bootstrap.seed
                )
                rows.append((prior, method, reference, *interval))
    return pd.DataFrame(rows, columns=["prior", "method", "reference", "iqm_difference", "ci_low", "ci_high"])


def _difference_of_iqms(scores: np.ndarray, axis: int) -> np.ndarray:
    return iqm(scores[..., 0], axis=axis) - iqm(scores[..., 1], axis=axis)


def prior_weight_table(cfg: GridworldConfig, data: Episodes) -> pd.DataFrame:
    """Mean prior weight of degraded and other states that evaluation episodes met, and their gap.

    Worlds are resampled whole: the visits of one student are no independent samples.
    """
    rows = []
    for prior in cfg.priors:
        for method in cfg.methods:
            if prior.startswith("structural") and get_method(method).adaptive:
                sums = [data.of(method, prior, name) for name in LOG_FIELDS[2:]]
                episodes = [part for w, n in (sums[:2], sums[2:]) for part in (w / np.maximum(n, 1), n > 0)]
                for average, parts in (("visit", sums), ("episode", episodes)):
                    of_worlds = np.stack([part.sum(-1) for part in parts], -1)[:, None]
                    with np.errstate(invalid="ignore"):  # a resample without a visit: NaN
                        found = stratified_bootstrap_ci(
                            of_worlds, _means_and_gap, reps=cfg.bootstrap.reps, seed=cfg.bootstrap.seed
                        )
                    rows.append((prior, method, average, *np.stack(found, -1).ravel()))
    names = (f"{name}{end}" for name in ("degraded", "non_degraded", "gap") for end in ("", "_ci_low", "_ci_high"))
    return pd.DataFrame(rows, columns=["prior", "method", "average", *names])


def _means_and_gap(sums: np.ndarray, axis: int) -> np.ndarray:
    """From sums and numbers of two groups, ``[..., 4]``: the mean of each, and that of the second minus the first."""
    total = sums.sum(axis)
    first, second = total[..., 0] / total[..., 1], total[..., 2] / total[..., 3]
    return np.stack([first, second, second - first], -1)


def world_table(results: dict[str, np.ndarray], data: Episodes) -> pd.DataFrame:
    """Facts about each world."""
    facts = {name: values for name, values in results.items() if name != "episodes"}
    return pd.DataFrame({**facts, "baseline_area": data.baseline})


def curve_table(cfg: GridworldConfig, data: Episodes) -> pd.DataFrame:
    """Mean return at each evaluation point with pointwise intervals; that of the baseline with every prior."""
    steps = np.arange(1, cfg.evaluation.points + 1) * cfg.evaluation.interval
    curves = {pair: mean_confidence_interval(data.of(*pair, "return")) for pair in data.pairs}
    frames = []
    for prior in cfg.priors:
        for method in cfg.methods:
            curve = curves[method, "" if method == "none" else prior]
            frame = pd.DataFrame({"prior": prior, "method": method, "transitions": steps})
            frames.append(frame.assign(mean=curve.estimate, ci_low=curve.low, ci_high=curve.high))
    return pd.concat(frames)


def prior_weight_curves(cfg: GridworldConfig, data: Episodes) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Mean prior weight by visit at each evaluation point, at degraded and at other states, by prior and method."""
    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for prior in cfg.priors:
        for method in cfg.methods:
            if prior.startswith("structural") and get_method(method).adaptive:
                sums = {name: data.of(method, prior, name).sum(0) for name in LOG_FIELDS[2:]}
                with np.errstate(invalid="ignore"):  # no visit: NaN, which is not drawn
                    means = (sums["w_degraded"] / sums["n_degraded"], sums["w_other"] / sums["n_other"])
                curves.setdefault(prior, {})[method] = means
    return curves


def tables_of(cfg: GridworldConfig, data: Episodes, results: dict[str, np.ndarray]) -> dict[str, pd.DataFrame]:
    """Every table of a study that has rows, by the name of its file."""
    tables = {
        "area_ratio": area_ratio_table(cfg, data),
        "comparisons": comparison_table(cfg, data),
        "prior_weights": prior_weight_table(cfg, data),
        "worlds": world_table(results, data),
        "curves": curve_table(cfg, data),
    }
    return {name: table for name, table in tables.items() if len(table)}
