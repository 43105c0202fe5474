"""What is known of a study's finished runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from recipes.common.run_folder import write_file
from recipes.mujoco_study.plan import StudyRun
from torchrl_priors.artifacts import read_manifest

__all__ = ["KEY", "Tables", "own_return", "read_table"]

#: What a run is known by in the tables.
KEY = ["env", "teacher", "method", "seed"]
#: What the means of training are of, where a method has it.
TRAINING = ("loss_objective", "entropy", "loss_prior", "prior_weight", "prior_cross_entropy")
#: What is kept of a trial.
TRIAL = ("winner", "margin", "confidence", "frames")
_TEXT = ("env", "teacher", "method", "metric")
#: How much of the key the rows of a table have that are not of one run.
_OF_KEY = {"_teachers": 2, "_settings": 3}


def read_table(path: Path, needed: Sequence[str]) -> pd.DataFrame:
    """A table of a study.

    Raises:
        ValueError: it is another table, or a damaged one; the message names file and column.
    """
    try:
        table = pd.read_csv(path, float_precision="round_trip", keep_default_na=False)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} is damaged: {error}") from None
    if absent := [name for name in needed if name not in table]:
        raise ValueError(f"{path} is no table of a study: it has no column {', '.join(absent)}.")
    for name in needed:
        if name not in _TEXT:
            values = pd.to_numeric(table[name], errors="coerce")
            if values.isna().any():
                raise ValueError(f"{path}: {int(values.isna().sum())} values of {name} are no numbers.")
            table[name] = values
    return table


def own_return(policy: Path) -> float | None:
    """The return that a policy's file says it has, if it says so."""
    value = read_manifest(policy).evaluation.get("mean_return")
    return None if value is None else float(value)


class Tables:
    """The tables in their files: read again for each run that is added, and each written whole or not at all."""

    def __init__(self, out: Path, name: str) -> None:
        self.files = {kind: out / f"{name}{kind}.csv" for kind in ("_training", "_trials", *_OF_KEY, "")}

    def rows(self, kind: str) -> pd.DataFrame:
        """The rows of a table; of one that is not there yet, none."""
        needed = KEY[: _OF_KEY.get(kind, len(KEY))]
        return read_table(self.files[kind], needed) if self.files[kind].exists() else pd.DataFrame(columns=needed)

    def finished(self) -> set[tuple]:
        """The keys of the runs that are there."""
        return set(self.rows("")[KEY].itertuples(index=False, name=None))

    def add(self, run: StudyRun) -> float:
        """Take a finished run in; its last return.

        Raises:
            ValueError: its teacher or its settings are not those of the other runs.
        """
        self.check([run])
        evaluations = pd.read_csv(run.folder / "eval.csv", float_precision="round_trip")
        columns = {"frames": "frames", "mean_return": "return", "std_return": "std", "episodes": "episodes"}
        metrics = pd.read_csv(run.folder / "metrics.csv", float_precision="round_trip")
        if "arm" in metrics:  # of a trial: those of the student who won it
            metrics = metrics[metrics["arm"] == json.loads((run.folder / "status.json").read_text())["arm"]]
        kept = [name for name in TRAINING if name in metrics and metrics[name].notna().any()]
        means = {"mean": [metrics[name].mean() for name in kept], "std": [metrics[name].std(ddof=0) for name in kept]}
        new = {
            "_settings": pd.DataFrame({"settings": [run.settings]}),
            "_training": pd.DataFrame({"metric": kept, **means, "rollouts": len(metrics)}),
            "": evaluations[list(columns)].rename(columns=columns),  # last: it says that the run is there
        }
        if (run.folder / "trials.json").exists():
            trials = json.loads((run.folder / "trials.json").read_text())
            rows = [trial | {"frames": sum(trial["frames"].values())} for trial in trials]
            new = {"_trials": pd.DataFrame(rows)[list(TRIAL)], **new}
        if (level := _level(run)) is not None:
            new = {"_teachers": pd.DataFrame({"return": [level]}), **new}
        for kind, table in new.items():
            self._put(kind, run.key, table)
        return float(evaluations["mean_return"].iloc[-1])

    def check(self, runs: Sequence[StudyRun]) -> None:
        """Refuse to mix runs with different teachers or settings.

        Raises:
            ValueError: the file of a teacher has another return than the teacher of the finished runs, or they had
                other settings.
        """
        settings = {tuple(row[:-1]): row[-1] for row in self.rows("_settings").itertuples(index=False)}
        for run in runs:
            if (before := settings.get(run.key[:3], run.settings)) != run.settings:
                raise ValueError(
                    f"{run} has the settings {run.settings}, but the runs in {self.files['']} have {before}: give the"
                    " study another name."
                )
        known = {(row.env, row.teacher): float(row[-1]) for row in self.rows("_teachers").itertuples(index=False)}
        for run in {run.key[:2]: run for run in runs}.values():
            level, before = _level(run), known.get(run.key[:2])
            if None not in (level, before) and level != before:
                raise ValueError(
                    f"{run.teacher} has a return of {level}, but the runs in {self.files['']} had a teacher with "
                    f"{before}: put that file back, or give the study another name."
                )

    def _put(self, kind: str, key: tuple, new: pd.DataFrame) -> None:
        """The rows of a key in the place of those that it has."""
        names = KEY[: _OF_KEY.get(kind, len(KEY))]
        old, key = self.rows(kind), key[: len(names)]
        others = old[[row != key for row in old[names].itertuples(index=False, name=None)]]
        new = new.assign(**dict(zip(names, key, strict=True)))[[*names, *new]]
        table = pd.concat([others, new] if len(others) else [new], ignore_index=True)
        ordered = table.sort_values(names, kind="stable", ignore_index=True)
        write_file(self.files[kind], ordered.to_csv(index=False))


def _level(run: StudyRun) -> float | None:
    """The return of a run's teacher that is used as its file has it."""
    file = run.teacher
    if file is None or run.degraded or file.suffix != ".safetensors" or not file.is_file():
        return None
    return own_return(file)
