"""From the evaluation episodes of a gridworld study to its tables and figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from recipes.common.run_folder import RunFolder
from recipes.gridworld.config import GridworldConfig
from recipes.gridworld.learners import runs_of
from recipes.gridworld.tabular import LOG_FIELDS
from torchrl_priors import plots
from torchrl_priors.envs import GridWorldEnv, GridWorlds
from torchrl_priors.methods import get_method
from torchrl_priors.metrics import (
    ConfidenceInterval,
    area_ratio,
    area_under_curve,
    iqm,
    mean_confidence_interval,
    stratified_bootstrap_ci,
)

__all__ = ["write"]

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
    """Mean prior weight of degraded and other states met in evaluation episodes, averaged over visits and episodes."""
    rows = []
    for prior in cfg.priors:
        for method in cfg.methods:
            if prior.startswith("structural") and get_method(method).adaptive:
                sums = {name: data.of(method, prior, name).ravel() for name in LOG_FIELDS[2:]}
                by_visit, by_episode = [], []
                for group in ("degraded", "other"):
                    total, square, count = (sums[f"{kind}_{group}"] for kind in ("w", "w2", "n"))
                    by_visit += _mean_and_ci_of_sums(total.sum(), square.sum(), count.sum())
                    met = total[count > 0] / count[count > 0]
                    by_episode += _mean_and_ci_of_sums(met.sum(), (met**2).sum(), len(met))
                rows += [(prior, method, "visit", *by_visit), (prior, method, "episode", *by_episode)]
    columns = ["prior", "method", "average", "degraded", "degraded_ci", "non_degraded", "non_degraded_ci"]
    return pd.DataFrame(rows, columns=columns)


def _mean_and_ci_of_sums(total: float, square: float, count: float) -> list[float]:
    """Mean and 1.96 standard errors of it, from a sum, a sum of squares and a number."""
    if count == 0:
        return [np.nan, np.nan]
    mean = total / count
    deviation = max(square / count - mean**2, 0.0) ** 0.5
    return [mean, 1.96 * deviation / count**0.5]


def world_table(results: dict[str, np.ndarray], data: Episodes) -> pd.DataFrame:
    """Facts about each world."""
    facts = {name: values for name, values in results.items() if name != "episodes"}
    return pd.DataFrame({**facts, "baseline_area": data.baseline})


def learning_curves(cfg: GridworldConfig, data: Episodes) -> dict[str, dict[str, ConfidenceInterval]]:
    """Mean return at each evaluation point with pointwise intervals, by prior and method."""
    baseline = mean_confidence_interval(data.of("none", "", "return"))
    curves = {}
    for prior in cfg.priors:
        curves[prior] = {"none": baseline}
        for method in cfg.methods:
            if method != "none":
                curves[prior][method] = mean_confidence_interval(data.of(method, prior, "return"))
    return curves


def curve_table(cfg: GridworldConfig, curves: dict[str, dict[str, ConfidenceInterval]]) -> pd.DataFrame:
    """The learning curves in long form."""
    steps = np.arange(1, cfg.evaluation.points + 1) * cfg.evaluation.interval
    frames = [
        pd.DataFrame({"prior": prior, "method": method, "transitions": steps}).assign(
            mean=curve.estimate, ci_low=curve.low, ci_high=curve.high
        )
        for prior, by_method in curves.items()
        for method, curve in by_method.items()
    ]
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


def figures(
    cfg: GridworldConfig, data: Episodes, ratios: pd.DataFrame, curves: dict[str, dict[str, ConfidenceInterval]]
) -> dict[str, Figure]:
    """The paper's figures, by the name of their file."""
    methods = [method for method in cfg.methods if method != "none"]
    profiles = {method: np.stack([data.ratio(method, prior) for prior in cfg.priors], -1) for method in methods}
    bars: dict[str, dict[str, ConfidenceInterval]] = {prior: {} for prior in cfg.priors}
    paper: dict[str, dict[str, ConfidenceInterval]] = {prior: {} for prior in cfg.priors}
    for row in ratios.itertuples():
        bars[row.prior][row.method] = ConfidenceInterval(row.iqm, row.ci_low, row.ci_high)
        if not np.isnan(row.paper_iqm):
            paper[row.prior][row.method] = ConfidenceInterval(row.paper_iqm, row.paper_ci_low, row.paper_ci_high)
    shown = {prior: {m: curve for m, curve in by_method.items() if m != "none"} for prior, by_method in curves.items()}
    steps = np.arange(1, cfg.evaluation.points + 1) * cfg.evaluation.interval
    return {
        "learning_curves": plots.learning_curves(
            shown, baseline=curves[cfg.priors[0]]["none"], steps=steps, profiles=profiles
        ),
        "performance_profiles": plots.performance_profiles(profiles),
        "iqm": plots.iqm_bars(bars, reference=paper if any(paper.values()) else None),
    }


def write(cfg: GridworldConfig, folder: RunFolder, world: GridWorlds, results: dict[str, np.ndarray]) -> None:
    """Write every table and figure into the folder, and print the main table and the paths."""
    data = Episodes(cfg, results["episodes"])
    curves = learning_curves(cfg, data)
    ratios, weights = area_ratio_table(cfg, data), prior_weight_table(cfg, data)
    tables = {
        "area_ratio": ratios,
        "comparisons": comparison_table(cfg, data),
        "prior_weights": weights,
        "worlds": world_table(results, data),
        "curves": curve_table(cfg, curves),
    }
    written = [
        folder.write(f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
        for name, table in tables.items()
        if len(table)
    ]
    pictures = {"world": GridWorldEnv(world).render()}
    if len(ratios):
        pictures |= figures(cfg, data, ratios, curves)
    if by_state := prior_weight_curves(cfg, data):
        steps = np.arange(1, cfg.evaluation.points + 1) * cfg.evaluation.interval
        pictures["prior_weights"] = plots.weight_curves(by_state, steps)
    for name, figure in pictures.items():
        written += plots.save_figure(figure, folder.path / name)

    print(f"\nArea ratio x 1000, IQM over {cfg.worlds} worlds (95 % CI), td_error={cfg.td_error}\n")
    print(_readable(ratios))
    if len(weights):
        print("\nPrior weight in evaluation episodes, by visit (+- 95 % CI)\n")
        by_visit = weights[weights.average == "visit"].drop(columns="average")
        by_visit = by_visit.rename(columns={"non_degraded": "other", "non_degraded_ci": "other_ci"})
        print(by_visit.to_string(index=False, float_format=lambda value: f"{value:.3f}"))
    print("\nWritten:", *(f"  {path}" for path in written), sep="\n")


def _readable(ratios: pd.DataFrame) -> str:
    """A block per prior, which fits into 80 columns whatever the number of methods."""

    def cell(estimate: float, low: float, high: float) -> str:
        return "" if np.isnan(estimate) else f"{1000 * estimate:.0f} ({1000 * low:.0f}, {1000 * high:.0f})"

    lines = [f"{'prior':16}{'method':20}{'here':>20}{'the paper':>20}"]
    for prior, rows in ratios.groupby("prior", sort=False):
        for row in rows.itertuples():
            here = cell(row.iqm, row.ci_low, row.ci_high)
            paper = cell(row.paper_iqm, row.paper_ci_low, row.paper_ci_high)
            lines.append(f"{prior:16}{row.method:20}{here:>20}{paper:>20}".rstrip())
            prior = ""
    return "\n".join(lines)
