"""The runs of a study, read from the tables that ``recipes.mujoco_study`` keeps: no run folder is needed."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from omegaconf import OmegaConf

from recipes.mujoco_study import KEY
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
    evaluations = _table(path, [*KEY, "frames", "return"])
    beside = path.with_name(f"{path.stem}_training.csv")
    training = _table(beside, [*KEY, "metric", "mean"]) if beside.exists() else pd.DataFrame(columns=[*KEY, "metric"])
    beside = path.with_name(f"{path.stem}_teachers.csv")
    teachers = _table(beside, ["env", "teacher", "return"]) if beside.exists() else pd.DataFrame()
    levels = {(row.env, row.teacher): row[-1] for row in teachers.itertuples(index=False)}
    means = {key: rows.set_index("metric")["mean"] for key, rows in training.groupby(KEY)} if len(training) else {}
    runs, left_out = [], []
    for key, rows in evaluations.groupby(KEY, sort=False):
        env, teacher, label, seed = key
        method = str(label).split()[0]
        if method not in {*METHODS, "trial"}:
            left_out.append(LeftOut(path, f"{env} {label}: there is no method {method!r}"))
            continue
        measured = {name: [value] for name, value in means.get(key, {}).items()}
        runs.append(
            FinishedRun(
                path=path,
                env=_env(str(env)),
                degrade={"none": "", "good": "none"}.get(str(teacher), str(teacher)),
                method=method,
                seed=int(seed),
                settings={},
                evaluations=rows[["frames", "return"]].rename(columns={"return": "mean_return"}),
                metrics=pd.DataFrame({"frames": [int(rows["frames"].iloc[-1])]} | measured),
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


def _table(path: Path, needed: list[str]) -> pd.DataFrame:
    try:
        table = pd.read_csv(path, float_precision="round_trip", keep_default_na=False)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    if absent := [name for name in needed if name not in table]:
        raise ValueError(f"{path} is no table of a study: it has no column {', '.join(absent)}.")
    for name in needed:
        if name not in ("env", "teacher", "method", "metric"):
            values = pd.to_numeric(table[name], errors="coerce")
            if values.isna().any():
                raise ValueError(f"{path}: {int(values.isna().sum())} values of {name} are no numbers.")
            table[name] = values
    return table
