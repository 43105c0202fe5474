"""The figures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from recipes.metrics import ConfidenceInterval
from recipes.plots import curve_panels, interval_panels, profile_panels
from recipes.report.tables import ALL, Study, span

__all__ = ["TRAINING", "curve_table", "figures"]

TRAINING = {
    "loss_objective": ("policy loss, difference", True),
    "entropy": ("entropy, difference", True),
    "loss_prior": ("auxiliary loss", False),
}
"""The paper's table: metrics, what they are called, and whether it gives the difference to the baseline."""

_BASELINE = "PPO"
#: Points of a curve over training: rollouts are averaged down to this many.
_POINTS = 50


def _title(study: Study, env: str, prior: str, number: str) -> str:
    shown = "All environments" if env == ALL else env
    break_and_prior = f"\n{prior}" if prior and len(study.priors) > 1 else ""
    return f"{shown}{break_and_prior} (n = {number})"


def _columns(study: Study) -> int | None:
    """Environments beside each other and priors below, where that makes a full table of panels."""
    panels = list(study.panels())
    envs = len({env for env, _ in panels})
    full = len(panels) == envs * len(study.priors)
    return envs if full and 1 < envs <= 4 and len(study.priors) > 1 else None


def curve_table(study: Study) -> pd.DataFrame:
    """IQM of the returns at each evaluation with its pointwise interval, in long form."""
    tables = []
    for env, prior, label, runs in study.groups():
        returns = np.array([run.evaluations["mean_return"] for run in runs])
        middle, low, high = study.interval(returns[:, None])
        table = pd.DataFrame({"env": env, "prior": prior, "method": label, "frames": runs[0].evaluations["frames"]})
        tables.append(table.assign(iqm=middle, ci_low=low, ci_high=high))
    return pd.concat(tables, ignore_index=True)


def figures(study: Study, curves: pd.DataFrame, ratios: pd.DataFrame, improvement: pd.DataFrame) -> dict[str, Figure]:
    """What there is data for, by the name of the file."""
    by_method: dict[str, list[str]] = {}
    for label in study.labels:
        by_method.setdefault(label.split()[0], []).append(label)
    crowded = {method: labels for method, labels in by_method.items() if len(labels) > 2}
    hidden = {label for labels in crowded.values() for label in labels[1:]}
    made = {"return_curves": _return_curves(study, curves, [label for label in study.labels if label not in hidden])}
    for method, labels in crowded.items():
        with_whom = [label for label in study.cfg.compare if label != study.cfg.baseline and label not in labels]
        made[f"return_curves_{method}"] = _return_curves(study, curves, [*with_whom, *labels])
    shown = [(env, prior) for prior in study.priors for env in (*study.envs, ALL)]
    if panels := _by_panel(study, ratios, shown, ["iqm", "ci_low", "ci_high"]):
        made["area_ratios"] = interval_panels(panels, columns=_with_all(study, panels))
        profiles = {
            f"{prior or 'All runs'} (n = {span(map(np.size, scores.values()))})": scores
            for prior in study.priors
            if (scores := _profiles(study, prior))
        }
        if profiles:
            boot = study.cfg.bootstrap
            made["performance_profiles"] = profile_panels(
                profiles, confidence=boot.confidence, reps=boot.reps, seed=boot.seed
            )
    for reference in study.cfg.compare:
        chosen = improvement[(improvement["reference"] == reference) & (improvement["score"] == "area")]
        if panels := _by_panel(study, chosen, shown, ["probability", "ci_low", "ci_high"]):
            name = _BASELINE if reference == "none" else reference.upper()
            made[f"improvement_over_{reference}"] = interval_panels(
                panels,
                columns=_with_all(study, panels),
                center=0.5,
                xlim=(-0.02, 1.02),
                xlabel=f"P(method > {name}), by area",
            )
    for metric, (name, differs) in {**TRAINING, "prior_weight": ("prior weight", False)}.items():
        if (figure := _training(study, metric, name, differs)) is not None:
            made[f"training_{metric}"] = figure
    return made


def _profiles(study: Study, prior: str) -> dict[str, np.ndarray]:
    """The area ratios of each method that was run in all environments of a prior."""
    students = [label for label in study.labels if label != study.cfg.baseline]
    return {label: scores for label in students if (scores := study.across(prior, label)) is not None}


def _with_all(study: Study, panels: Mapping[str, object]) -> int | None:
    """Panels in a row of the figure that has one for all environments at the end of each."""
    per_prior = len(panels) // len(study.priors)
    return per_prior if len(study.priors) > 1 and per_prior <= 4 and len(panels) % len(study.priors) == 0 else None


def _by_panel(
    study: Study, table: pd.DataFrame, shown: list[tuple[str, str]], columns: list[str]
) -> dict[str, dict[str, ConfidenceInterval]]:
    panels = {}
    for env, prior in shown:
        rows = table[(table["env"] == env) & (table["prior"] == prior)]
        if len(rows):
            values = rows[columns].to_numpy()
            panels[_title(study, env, prior, span(rows["runs"]))] = {
                method: ConfidenceInterval(*row) for method, row in zip(rows["method"], values, strict=True)
            }
    return panels


def _return_curves(study: Study, curves: pd.DataFrame, labels: Sequence[str]) -> Figure:
    by_group = dict(iter(curves.groupby(["env", "prior", "method"], sort=False)))
    panels: dict[str, dict[str, ConfidenceInterval]] = {}
    steps: dict[str, np.ndarray] = {}
    teachers: dict[str, dict[str, float]] = {}
    for env, prior in study.panels():
        shown = [label for label in study.methods(env, prior) if label in labels]
        if not shown:
            continue
        title = _title(study, env, prior, study.number(env, prior, shown))
        panels[title] = {}
        if (level := study.teacher(env, prior)) is not None:
            teachers[title] = {"Teacher": level}
        for label in shown:
            rows = by_group[env, study.runs(env, prior, label)[0].prior, label]
            panels[title][label] = ConfidenceInterval(*rows[["iqm", "ci_low", "ci_high"]].to_numpy().T)
            steps[title] = rows["frames"].to_numpy()
    options: Any = {"columns": _columns(study), "ylabel": "Evaluation return (IQM)", "baseline": _BASELINE}
    return curve_panels(panels, steps, references=teachers, **options)


def _training(study: Study, metric: str, name: str, differs: bool) -> Figure | None:
    """A metric over training: mean over seeds, and from the lowest to the highest of them."""
    panels: dict[str, dict[str, ConfidenceInterval]] = {}
    steps: dict[str, dict[str, np.ndarray]] = {}
    for env, prior in study.panels():
        base = _by_frames(study, env, prior, study.cfg.baseline, metric)
        for label in study.methods(env, prior):
            curves = _by_frames(study, env, prior, label, metric)
            if curves is None or len(curves) < 2 or (differs and label == study.cfg.baseline):
                continue  # a study's table has the mean over training only
            if differs:
                if base is None:
                    continue
                curves = curves.sub(base.mean(axis=1), axis=0).dropna(how="all")
            if len(curves):
                points = np.arange(len(curves)) * _POINTS // max(len(curves), _POINTS)
                means = curves.groupby(points).mean()
                title = _title(study, env, prior, study.number(env, prior, study.methods(env, prior)))
                seeds = means.to_numpy()
                panels.setdefault(title, {})[label] = ConfidenceInterval(
                    seeds.mean(axis=1), seeds.min(axis=1), seeds.max(axis=1)
                )
                steps.setdefault(title, {})[label] = curves.index.to_series().groupby(points).mean().to_numpy()
    if not panels:
        return None
    to = f" to {_BASELINE if study.cfg.baseline == 'none' else study.cfg.baseline}" if differs else ""
    return curve_panels(panels, steps, columns=_columns(study), ylabel=f"{name[0].upper()}{name[1:]}{to}")


def _by_frames(study: Study, env: str, prior: str, label: str, metric: str) -> pd.DataFrame | None:
    """A column per seed, at the frames that all of them have."""
    runs = study.runs(env, prior, label)
    if not runs or not all(metric in run.metrics for run in runs):
        return None
    columns = [run.metrics.set_index("frames")[metric] for run in runs]
    return pd.concat(columns, axis=1, join="inner")
