"""The tables of a report: returns, area ratios, probability of improvement, and what training looked like."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from recipes.metrics import (
    MIN_RUNS,
    ConfidenceInterval,
    area_ratio,
    area_under_curve,
    iqm,
    probability_of_improvement,
    stratified_bootstrap_ci,
)
from recipes.report.config import ReportConfig
from recipes.report.runs import FinishedRun, method_order

__all__ = ["ALL", "Study", "change", "dynamics_table", "improvement_table", "ratio_table", "return_table"]

ALL = "all"
_PAPER = Path(__file__).with_name("paper_training_metrics.csv")


class Study:
    """Runs by environment, prior and method.

    Runs without a prior are found under every prior of their environment: they are what each is compared with.
    """

    def __init__(self, runs: Sequence[FinishedRun], cfg: ReportConfig) -> None:
        self.cfg = cfg
        self._noted: dict[str, dict[str, None]] = {}
        self._groups: dict[tuple[str, str, str], list[FinishedRun]] = {}
        for run in runs:
            self._groups.setdefault((run.env, run.prior, run.label), []).append(run)
        self.envs = list(dict.fromkeys(run.env for run in runs))
        self.degraded = {run.prior for run in runs if run.degraded}
        priors = dict.fromkeys(run.prior for run in sorted(runs, key=lambda run: run.degraded) if run.prior)
        self.priors = list(priors) or [""]
        # in the methods' order, whatever the environment that each was run in
        self.labels = list(dict.fromkeys(run.label for run in sorted(runs, key=method_order)))

    def note(self, text: str, label: str = "") -> None:
        """Something that a reader has to know, said once; ``{}`` stands for all methods of which it is said."""
        self._noted.setdefault(text, {})[label] = None

    @property
    def notes(self) -> list[str]:
        """What was noted."""
        return [text.replace("{}", ", ".join(labels)) for text, labels in self._noted.items()]

    def runs(self, env: str, prior: str, label: str) -> list[FinishedRun]:
        """The runs of a method, one a seed."""
        return self._groups.get((env, prior, label)) or self._groups.get((env, "", label), [])

    def groups(self) -> Iterator[tuple[str, str, str, list[FinishedRun]]]:
        """Every environment, prior and method with runs; what has no prior comes once, under ``""``."""
        for env in self.envs:
            for prior in ("", *(prior for prior in self.priors if prior)):
                for label in self.labels:
                    if group := self._groups.get((env, prior, label)):
                        yield env, prior, label, group

    def methods(self, env: str, prior: str) -> list[str]:
        """The methods with runs in an environment, the baselines included."""
        return [label for label in self.labels if self.runs(env, prior, label)]

    def number(self, env: str, prior: str, labels: Iterable[str]) -> str:
        """How many runs some methods of a panel have."""
        return span(len(self.runs(env, prior, label)) for label in labels)

    def teacher(self, env: str, prior: str) -> float | None:
        """Return of the teacher of a panel, where it is known."""
        known = [run.teacher_return for run in self._of_prior(env, prior) if run.teacher_return is not None]
        return known[0] if known else None

    def _of_prior(self, env: str, prior: str) -> list[FinishedRun]:
        return [run for key, runs in self._groups.items() if key[:2] == (env, prior) for run in runs]

    def panels(self) -> Iterator[tuple[str, str]]:
        """Environments and priors to show side by side, prior by prior."""
        for prior in self.priors:
            for env in self.envs:
                if any(key[:2] == (env, prior) for key in self._groups):
                    yield env, prior

    def envs_of(self, prior: str) -> list[str]:
        """The environments that have runs with a prior."""
        return [env for env, other in self.panels() if other == prior]

    def interval(self, scores: np.ndarray, aggregate: Callable[..., Any] = iqm) -> ConfidenceInterval:
        """IQM of ``[runs, tasks, *rest]`` and its stratified bootstrap interval, NaN where there are too few runs."""
        interval = stratified_bootstrap_ci(scores, aggregate, **bootstrap(self.cfg))
        none = np.full_like(interval.low, np.nan)
        return interval if len(scores) >= MIN_RUNS else interval._replace(low=none, high=none)

    def ratios(self, env: str, prior: str, label: str) -> dict[int, float]:
        """Area ratio to the baseline by seed, its sign that of the gain: divided by the size of the baseline's area."""
        base = {run.seed: area(run) for run in self.runs(env, prior, self.cfg.baseline)}
        ratios = {}
        for run in self.runs(env, prior, label) if base else []:
            if self.cfg.pairing == "mean":
                reference = float(np.mean(list(base.values())))
            elif run.seed in base:
                reference = base[run.seed]
            else:
                self.note(
                    f"{env}: {label}{of(prior)} has no area ratio for seed {run.seed}, which {self.cfg.baseline} lacks."
                )
                continue
            ratios[run.seed] = float(area_ratio(area(run), reference)) * (-1.0 if reference < 0 else 1.0)
        return ratios

    def common(self, envs: Sequence[str], prior: str, label: str) -> list[list[FinishedRun]]:
        """The runs of a method by seed and environment, of the seeds that it has in each environment."""
        by_seed = [{run.seed: run for run in self.runs(env, prior, label)} for env in envs]
        seeds = sorted(set.intersection(*(set(runs) for runs in by_seed)))
        return [[runs[seed] for runs in by_seed] for seed in seeds]

    def across(self, prior: str, label: str) -> np.ndarray | None:
        """Area ratios ``[seeds, environments]`` of a method that was run in all environments of a prior, or None."""
        envs = self.envs_of(prior)
        by_env = {env: self.ratios(env, prior, label) for env in envs}
        absent = [env for env in envs if not by_env[env]]
        seeds = sorted(set.intersection(*(set(ratios) for ratios in by_env.values()))) if envs else []
        if absent or not seeds:
            if len(absent) < len(envs):
                why = f"no area ratio in {', '.join(absent)}" if absent else "no seed common to all environments"
                self.note(f"Aggregates over environments{of(prior)} are without {{}}: {why}.", label)
            return None
        if any(len(ratios) > len(seeds) for ratios in by_env.values()):
            numbers = ", ".join(map(str, seeds))
            self.note(f"Aggregates of {{}}{of(prior)} are over the seeds common to all environments: {numbers}.", label)
        return np.array([[by_env[env][seed] for env in envs] for seed in seeds])


def span(numbers: Iterable[int]) -> str:
    """From the smallest to the largest number."""
    known = sorted(numbers)
    return "-".join(str(number) for number in dict.fromkeys((known[0], known[-1])))


def of(prior: str) -> str:
    """How a prior is named after a method."""
    return f" ({prior})" if prior else ""


def bootstrap(cfg: ReportConfig) -> dict:
    """Arguments of every interval."""
    return {"confidence": cfg.bootstrap.confidence, "reps": cfg.bootstrap.reps, "seed": cfg.bootstrap.seed}


def area(run: FinishedRun) -> float:
    """Area under the evaluation curve, per frame."""
    return float(area_under_curve(run.evaluations["mean_return"]))


def final(run: FinishedRun) -> float:
    """Mean return of the last evaluation."""
    return float(run.evaluations["mean_return"].iloc[-1])


def change(run: FinishedRun, start: float) -> float:
    """The last return minus the first one from a share of the frames on; NaN where these are one."""
    frames = run.evaluations["frames"]
    late = run.evaluations["mean_return"][frames >= start * frames.iloc[-1] * (1 - 1e-9)]
    return float(late.iloc[-1] - late.iloc[0]) if len(late) > 1 else np.nan


def return_table(study: Study) -> pd.DataFrame:
    """Return of the last evaluation, how it changed and mean return of all of them, with intervals over seeds."""
    rows = []
    for env, prior, label, runs in study.groups():
        last, areas = np.array([final(run) for run in runs]), np.array([area(run) for run in runs])
        spread = last.std(ddof=1) if len(runs) > 1 else np.nan
        frames = int(runs[0].evaluations["frames"].iloc[-1])
        changes = np.array([change(run, study.cfg.change_from) for run in runs])
        known = np.isfinite(changes).all()
        intervals = [study.interval(last), study.interval(areas)]
        intervals.append(study.interval(changes, np.mean) if known else ConfidenceInterval(*[np.nan] * 3))
        rows.append((env, prior, label, len(runs), frames, last.mean(), spread, *itertools.chain(*intervals)))
    columns = ["env", "prior", "method", "runs", "frames", "final_mean", "final_std"]
    columns += ["final_iqm", "final_ci_low", "final_ci_high", "area_iqm", "area_ci_low", "area_ci_high"]
    return pd.DataFrame(rows, columns=[*columns, "change_mean", "change_ci_low", "change_ci_high"])


def ratio_table(study: Study) -> pd.DataFrame:
    """IQM of the area ratio per environment and over all of them, and the baseline's area."""
    rows: list[tuple] = []
    for env, prior in study.panels():
        base = [area(run) for run in study.runs(env, prior, study.cfg.baseline)]
        for label in study.methods(env, prior):
            if label != study.cfg.baseline and (ratios := study.ratios(env, prior, label)):
                interval = study.interval(np.array(list(ratios.values())))
                rows.append((env, prior, label, len(ratios), *interval, float(np.mean(base)), min(base) <= 0))
        if not base:
            study.note(f"{env}: no area ratios{of(prior)}, for there is no run of the baseline {study.cfg.baseline!r}.")
        elif min(base) <= 0:
            study.note(
                f"{env}: the baseline's area is negative in {sum(a <= 0 for a in base)} of {len(base)} runs. Ratios "
                "are divided by its size, so that more than 0 is better than the baseline; their size says little."
            )
    rows += [
        (ALL, prior, label, len(scores), *study.interval(scores), np.nan, None)
        for prior in study.priors
        if len(study.envs_of(prior)) > 1
        for label in study.labels
        if label != study.cfg.baseline and (scores := study.across(prior, label)) is not None
    ]
    columns = ["env", "prior", "method", "runs", "iqm", "ci_low", "ci_high", "baseline_area", "negative_baseline"]
    return pd.DataFrame(rows, columns=columns)


def improvement_table(study: Study) -> pd.DataFrame:
    """Probability that a run of a method beats one of another, by area and by last return; seeds are not paired.

    Over all environments it is the mean of theirs, from the seeds that a method has in all of them.
    """
    rows = []
    groups = [([env], prior) for env, prior in study.panels()]
    groups += [(envs, prior) for prior in study.priors if len(envs := study.envs_of(prior)) > 1]
    for chosen, prior in groups:
        env = chosen[0] if len(chosen) == 1 else ALL
        for reference in study.cfg.compare:
            y = study.common(chosen, prior, reference)
            for label in study.labels:
                x = study.common(chosen, prior, label)
                if x and y and label != reference and label != study.cfg.baseline:
                    for name, score in (("area", area), ("final", final)):
                        sides = ([[score(run) for run in row] for row in side] for side in (x, y))
                        found = probability_of_improvement(*sides, **bootstrap(study.cfg))
                        if min(len(x), len(y)) < MIN_RUNS:
                            found = found._replace(low=np.nan, high=np.nan)
                        rows.append((env, prior, label, reference, name, len(x), len(y), *found))
    columns = ["env", "prior", "method", "reference", "score", "runs", "reference_runs", "probability"]
    return pd.DataFrame(rows, columns=[*columns, "ci_low", "ci_high"])


def dynamics_table(study: Study) -> pd.DataFrame:
    """Mean and standard deviation over training of what was logged, and of its difference to the baseline.

    The difference is to the mean of the baseline's runs at the same frames; points of all runs count alike. Means over
    training, as of a study's table, have no standard deviation of the difference, and none where rollouts differ.
    """
    rows = []
    for env, prior, label, runs in study.groups():
        base = pd.concat([run.metrics for run in study.runs(env, prior, study.cfg.baseline)] or [pd.DataFrame()])
        reference = base.groupby("frames").mean() if len(base) else None
        logged = pd.concat([run.metrics for run in runs]).set_index("frames")
        for metric in logged.columns:
            values = logged[metric].dropna()
            gap = (
                (values - reference[metric].reindex(values.index)).dropna()
                if reference is not None and metric in reference and label != study.cfg.baseline
                else values.iloc[:0]
            )
            if len(values):
                within = [run.within[metric] for run in runs if metric in run.within]
                spread = float(np.hypot(values.std(ddof=0), np.sqrt(np.mean(np.square(within))) if within else 0))
                spreads = (spread, gap.mean(), np.nan if within else gap.std(ddof=0))
                means = np.array([run.metrics[metric].mean() for run in runs if metric in run.metrics])
                ends = study.interval(means[np.isfinite(means)], np.mean)[1:]
                rows.append((env, prior, label, metric, len(runs), float(values.mean()), *ends, *spreads))
    columns = ["env", "prior", "method", "metric", "runs", "mean", "mean_ci_low", "mean_ci_high"]
    columns += ["std", "difference", "difference_std"]
    return _with_paper(pd.DataFrame(rows, columns=columns), study)


def _with_paper(table: pd.DataFrame, study: Study) -> pd.DataFrame:
    """What the paper reports beside it, for good teachers: differences to PPO, but the auxiliary loss itself."""
    paper = pd.read_csv(_PAPER).rename(columns={"mean": "paper_mean", "std": "paper_std"})
    keys = pd.DataFrame(
        {
            "env": table["env"].str.replace(r"-v\d+$", "", regex=True).str.lower(),
            "method": table["method"].str.split().str[0],
            "metric": table["metric"].where(~table["prior"].isin(study.degraded)),
        }
    )
    matched = keys.merge(paper.assign(env=paper["env"].str.lower()), how="left", on=["env", "method", "metric"])
    return table.assign(paper_mean=matched["paper_mean"].to_numpy(), paper_std=matched["paper_std"].to_numpy())
