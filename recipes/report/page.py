"""The pages of a report, from what :mod:`recipes.report.runs` finds."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf

from recipes.common.checks import require
from recipes.common.run_folder import write_file
from recipes.gridworld import page as gridworld
from recipes.plots import save_figure
from recipes.report.command import command
from recipes.report.config import ReportConfig, check
from recipes.report.figures import TRAINING, curve_table, figures
from recipes.report.markdown import interval, pivot, plus_minus, table
from recipes.report.runs import (
    FinishedRun,
    LeftOut,
    find,
    is_gridworld,
    name_priors,
    read,
    short_paths,
    without_misfits,
)
from recipes.report.shares import BELOW, LOWER, share_table
from recipes.report.study import is_study, read_study
from recipes.report.tables import ALL, Study, dynamics_table, improvement_table, ratio_table, return_table
from torchrl_priors.methods import METHODS

__all__ = ["report"]

_CAPTIONS = {
    "return_curves": "Evaluation returns: interquartile mean over seeds, and the teacher's return",
    "area_ratios": "Area ratio to the baseline",
    "performance_profiles": "Performance profiles of the area ratio over environments and seeds",
    "improvement": "Probability that a run has the larger area under its evaluation curve",
    **{
        f"training_{metric}": f"{name[0].upper()}{name[1:]}, over training: mean, lowest and highest seed"
        for metric, (name, _) in TRAINING.items()
    },
    "training_prior_weight": "Prior weight over training: mean, lowest and highest seed",
}


def report(cfg: ReportConfig) -> Path:
    """Write the report; the path of its page.

    Raises:
        ValueError: a key is wrong, or there is no run that can be used; the message names them.
    """
    check(cfg)
    runs: Any = OmegaConf.to_container(cfg.runs) if OmegaConf.is_config(cfg.runs) else cfg.runs
    folders = find(runs)
    out = Path(cfg.out)
    studies = {folder.resolve(): folder for folder in folders if is_gridworld(folder)}
    if len(folders) == len(studies) == 1:
        return gridworld.write(folders[0], out)[-1]
    usable, left_out = _usable(cfg, [folder for folder in folders if folder.resolve() not in studies])
    pages = []
    for path, name in sorted(short_paths(studies).items()):
        try:
            pages.append(gridworld.write(studies[path], out / name)[-1])
        except ValueError as error:
            left_out.append(LeftOut(studies[path], str(error)))
    for entry in left_out:
        print(f"Left out: {entry.path}: {entry.reason}", file=sys.stderr)
    if not usable and not pages:
        raise ValueError(f"runs={runs}: none of the {len(left_out)} runs can be used (see above).")
    if usable:
        pages.insert(0, _report_runs(cfg, usable, left_out, out))
    return _index(out, pages, left_out) if studies else pages[0]


def _usable(cfg: ReportConfig, folders: Sequence[Path]) -> tuple[list[FinishedRun], list[LeftOut]]:
    found, left_out = read([folder for folder in folders if not is_study(folder)])
    name_priors(found)
    for path in filter(is_study, folders):
        runs, unknown = read_study(path)
        found, left_out = found + runs, left_out + unknown
    if absent := sorted(set(cfg.envs) - (known := {run.env for run in found})):
        raise ValueError(f"envs={list(cfg.envs)}: there is no run in {', '.join(absent)}, but in {sorted(known)}.")
    found = [run for run in found if not cfg.envs or run.env in cfg.envs]
    labels = {run.label for run in found}
    for key, names in (("baseline", [cfg.baseline]), ("compare", cfg.compare)):
        known = {*METHODS, "trial", *labels}
        require(known.issuperset(names), key, getattr(cfg, key), f"of {', '.join(sorted(known))}")
    usable, misfits = without_misfits(found)
    return usable, left_out + misfits


def _index(out: Path, pages: Sequence[Path], left_out: Sequence[LeftOut]) -> Path:
    links = [page.relative_to(out) for page in pages]
    parts = ["# Reports", "\n".join(f"- [{link.parent if link.parent.name else 'runs'}]({link})" for link in links)]
    parts += _left_out(left_out)
    return write_file(out / "README.md", "\n\n".join(parts) + "\n")


def _left_out(entries: Sequence[LeftOut]) -> list[str]:
    if not entries:
        return []
    rows = [(f"`{entry.path}`", entry.reason) for entry in entries]
    heading = f"**Left out** ({len(entries)}), in no number and no figure here."
    return [heading, table(["run", "why"], rows, text_columns=2)]


def _report_runs(cfg: ReportConfig, usable: Sequence[FinishedRun], left_out: Sequence[LeftOut], out: Path) -> Path:
    study = Study(usable, cfg)
    tables = {
        "returns": return_table(study),
        "area_ratio": ratio_table(study),
        "improvement": improvement_table(study),
        "dynamics": dynamics_table(study),
        "shares": share_table(study),
        "curves": curve_table(study),
        "left_out": pd.DataFrame([(str(entry.path), entry.reason) for entry in left_out], columns=["run", "reason"]),
    }
    pictures = figures(study, tables["curves"], tables["area_ratio"], tables["improvement"])
    for name, content in tables.items():
        write_file(out / f"{name}.csv", content.to_csv(index=False, float_format="%.6g"))
    for name, figure in pictures.items():
        save_figure(figure, out / name)
    used = pd.DataFrame([(run.env, run.prior, run.label, run.seed) for run in usable])
    used.columns = ["env", "prior", "method", "seed"]
    page = _page(study, used, tables, left_out, list(pictures))
    return write_file(out / "report.md", page)


def _page(
    study: Study,
    used: pd.DataFrame,
    tables: dict[str, pd.DataFrame],
    left_out: Sequence[LeftOut],
    pictures: Sequence[str],
) -> str:
    cfg, level = study.cfg, f"{100 * study.cfg.bootstrap.confidence:g} %"
    parts = [
        "# Report",
        f"```bash\n{command(cfg)}\n```",
        f"{len(used)} runs. Intervals are {level} stratified bootstrap over seeds ({cfg.bootstrap.reps} resamples); "
        "IQM is the interquartile mean; with fewer than four seeds it is the mean, and there is no interval. "
        f"Area: mean return over the evaluations. Baseline: `{cfg.baseline}`.",
    ]
    seeds = used.groupby(["env", "prior", "method"], sort=False)["seed"].agg(list).reset_index()
    parts.append(pivot(seeds.replace({"prior": {"": "-"}}), ["env", "prior"], lambda row: _seeds(row["seed"])))
    parts += [f"> {note}" for note in study.notes]
    parts += _left_out(left_out)
    parts += ["## Returns", *(_figure(name) for name in pictures if name.startswith("return_curves"))]
    parts += ["Last evaluation, IQM over seeds:"]
    returns = tables["returns"].replace({"prior": {"": "-"}})
    last = pivot(
        returns, ["env", "prior"], lambda row: interval(row["final_iqm"], row["final_ci_low"], row["final_ci_high"], 1)
    )
    parts += [last, "Mean and standard deviation over seeds:"]
    parts.append(pivot(returns, ["env", "prior"], lambda row: plus_minus(row["final_mean"], row["final_std"], 1)))

    start = f"{100 * cfg.change_from:g} % of the frames"
    parts += [f"Change of the return from the first evaluation at {start} to the last one, mean over seeds:"]
    parts.append(
        pivot(
            returns,
            ["env", "prior"],
            lambda row: interval(row["change_mean"], row["change_ci_low"], row["change_ci_high"], 1),
        )
    )
    parts += _shares(tables["shares"], LOWER, f"Runs that end below their return at {start}")

    if len(ratios := tables["area_ratio"]):
        versus = "of the same seed" if cfg.pairing == "seed" else "on average"
        parts += ["## Area ratios", f"(A - A₀)/|A₀|, where A₀ is the area of the baseline {versus}. IQM over seeds."]
        shown = ratios.replace({"env": {ALL: "**all**"}})
        parts.append(pivot(shown, ["env", "prior"], lambda row: interval(*row[["iqm", "ci_low", "ci_high"]])))
        parts += _shares(tables["shares"], BELOW, "Runs with a negative area ratio")
        parts += [_figure(name) for name in ("area_ratios", "performance_profiles") if name in pictures]
    if len(improvement := tables["improvement"]):
        parts += ["## Probability of improvement"]
        for score, text in (("area", "area under the evaluation curve"), ("final", "return of the last evaluation")):
            chosen = improvement[improvement["score"] == score]
            parts += [
                f"By the {text}; ½ is a draw:",
                pivot(
                    chosen, ["env", "prior", "reference"], lambda r: interval(*r[["probability", "ci_low", "ci_high"]])
                ),
            ]
        parts += [_figure(name) for name in pictures if name.startswith("improvement")]
    parts += ["## Training", _dynamics(tables["dynamics"])]
    parts += [_figure(name) for name in pictures if name.startswith("training_")]
    files = ", ".join(f"[`{name}.csv`]({name}.csv)" for name in tables)
    parts.append(f"All numbers: {files}. Figures are there as PDF too.")
    return "\n\n".join(parts) + "\n"


def _shares(shares: pd.DataFrame, what: str, text: str) -> list[str]:
    shown = shares[shares["what"] == what].replace({"env": {ALL: "**all**"}, "prior": {"": "-"}})
    cells = pivot(
        shown,
        ["env", "prior"],
        lambda row: interval(*row[["share", "ci_low", "ci_high"]]) + f", {row['count']} of {row['runs']}",
    )
    return [f"{text}, their share and its Wilson interval:", cells] if len(shown) else []


def _seeds(seeds: Sequence[int]) -> str:
    ordered = sorted(seeds)
    run = len(ordered) > 2 and ordered[-1] - ordered[0] == len(ordered) - 1
    return f"{ordered[0]}-{ordered[-1]}" if run else ", ".join(map(str, ordered))


def _figure(name: str) -> str:
    caption = next(text for key, text in _CAPTIONS.items() if name.startswith(key))
    return f"![{caption}]({name}.png)"


def _dynamics(dynamics: pd.DataFrame) -> str:
    """The paper's table: mean ± std over training, and the paper's numbers in square brackets."""
    rows = []
    for (env, prior, method), group in dynamics.groupby(["env", "prior", "method"], sort=False):
        by_metric = group.set_index("metric")
        cells = []
        for metric, (_, differs) in TRAINING.items():
            row = by_metric.loc[metric] if metric in by_metric.index else None
            mean, std = ("difference", "difference_std") if differs else ("mean", "std")
            ours = "-" if row is None else plus_minus(row[mean], row[std], 3)
            paper = "" if row is None or pd.isna(row["paper_mean"]) else _paper(row["paper_mean"], row["paper_std"])
            cells.append(ours + paper)
        if set(cells) != {"-"}:
            rows.append([env, prior or "-", method, *cells])
    head = ["env", "prior", "method", *(name for name, _ in TRAINING.values())]
    text = (
        "Mean ± standard deviation over training and seeds; differences are to the baseline at the same frames (from a "
        "study's table: of means, without ±, and not of a trial's winner, which has fewer rollouts). In "
        "square brackets what the paper reports with its own teachers (v3 environments; which Cω is not said)."
    )
    return f"{text}\n\n{table(head, rows, text_columns=3)}"


def _paper(mean: float, std: float) -> str:
    return f" [{mean:g} ± {std:g}]"
