"""The runs of a study, read from the tables that ``recipes.mujoco_study`` keeps: no run folder is needed."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from omegaconf import OmegaConf

from recipes.mujoco_study.tables import KEY, read_table
from recipes.report.runs import FinishedRun, LeftOut, env_name
from torchrl_priors.methods import METHODS

__all__ = ["is_study", "read_study"]

_ENVS = Path(__file__).parents[2] / "conf" / "env"


def is_study(path: Path) -> bool:
    """Whether this is the table of a study's evaluations."""
    return path.suffix == ".csv" and path.is_file()


def read_study(path: Path) -> tuple[list[FinishedRun], list[LeftOut]]:
    """The runs of a study, with the means of their training if its table is beside that of the evaluations.

    Raises:
        ValueError: it is another table, or a damaged one; the message names file and column.
    """
    evaluations = read_table(path, [*KEY, "frames", "return"])
    beside = path.with_name(f"{path.stem}_training.csv")
    columns = [*KEY, "metric", "mean", "std", "rollouts"]
    training = read_table(beside, columns) if beside.exists() else pd.DataFrame(columns=columns)
    beside = path.with_name(f"{path.stem}_teachers.csv")
    teachers = read_table(beside, ["env", "teacher", "return"]) if beside.exists() else pd.DataFrame()
    levels = {(row.env, row.teacher): row[-1] for row in teachers.itertuples(index=False)}
    measured = {key: rows.set_index("metric") for key, rows in training.groupby(KEY)}
    runs, left_out = [], []
    for key, rows in evaluations.groupby(KEY, sort=False):
        env, teacher, label, seed = key
        method = str(label).split()[0]
        if method not in {*METHODS, "trial"}:
            left_out.append(LeftOut(path, f"{env} {label}: there is no method {method!r}"))
            continue
        means = measured.get(key, training.set_index("metric").iloc[:0])
        runs.append(
            FinishedRun(
                path=path,
                env=_env(str(env)),
                degrade={"none": "", "good": "none"}.get(str(teacher), str(teacher)),
                method=method,
                seed=int(seed),
                settings={},
                evaluations=rows.sort_values("frames")[["frames", "return"]].rename(columns={"return": "mean_return"}),
                # means can be compared with those of as many rollouts: a trial's winner has fewer than the baseline
                metrics=means[["mean"]].T.assign(frames=means["rollouts"].max()).reset_index(drop=True),
                within=means["std"].to_dict(),
                teacher_return=levels.get((env, teacher)),
                prior="" if teacher == "none" else f"{teacher} teacher",
                label=str(label),
            )
        )
    return runs, left_out


def _env(name: str) -> str:
    """The environment of a file of ``conf/env``, as other reports call it; any other name as it is."""
    file = _ENVS / f"{name}.yaml"
    return env_name(OmegaConf.to_container(OmegaConf.load(file))) if file.is_file() else name
