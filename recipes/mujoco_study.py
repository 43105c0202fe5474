"""Many runs of the MuJoCo recipe as one study: what is missing is run, and what is finished is kept in small tables.

    python -m recipes.mujoco_study study_mujoco=trial [workers=2] [run=false] [key=value ...]

The tables are all that a report needs, and all that has to be kept: ``<name>.csv`` has every evaluation,
``<name>_training.csv`` the means of what training measured, ``<name>_trials.csv`` who won the trials,
``<name>_teachers.csv`` the return of each teacher. A run that is in
them is not run again, on whichever machine they are. One that was interrupted goes on from its checkpoint, and one that
fails or is killed stops no other. ``run=false`` says what is missing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import pandas as pd
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from recipes.common.checks import check_keys, positive
from recipes.common.preemption import end_with_parent
from recipes.common.sweeps import start
from torchrl_priors.artifacts import read_manifest
from torchrl_priors.atomic import write_atomically

#: What a run is known by in the tables.
KEY = ["env", "teacher", "method", "seed"]
#: What the means of training are of, where a method has it.
TRAINING = ("loss_objective", "entropy", "loss_prior", "prior_weight", "prior_cross_entropy")
#: What is kept of a trial.
TRIAL = ("winner", "margin", "confidence", "frames")
ROOT = Path(__file__).parents[1]


@dataclass
class StudyConfig:
    """The whole configuration of ``python -m recipes.mujoco_study``."""

    name: str = MISSING
    set: dict[str, Any] = MISSING
    teachers: dict[str, dict[str, Any]] = MISSING
    runs: list[Any] = MISSING
    workers: int = positive()
    run: bool = MISSING
    out: str = MISSING
    work: str = MISSING


ConfigStore.instance().store(group="schema", name="mujoco_study", node=StudyConfig, package="_global_")


@dataclass(frozen=True)
class StudyRun:
    """One run of the study.

    Attributes:
        key: its environment, teacher, method and seed, as in the tables.
        overrides: of ``recipes.mujoco``.
        folder: where it is run.
    """

    key: tuple[str, str, str, int]
    overrides: tuple[str, ...]
    folder: Path

    def __str__(self) -> str:
        """For a line of progress."""
        env, teacher, method, seed = self.key
        return f"{env} {method} {teacher} seed {seed}"


def expand(cfg: StudyConfig) -> list[StudyRun]:
    """The runs that the configuration stands for, in its order, seed by seed.

    Raises:
        ValueError: an unknown teacher, or a block that lacks an entry or has one too many; the message names it.
    """
    found: dict[tuple, StudyRun] = {}
    for number, block in enumerate(cfg.runs):
        needed, known = {"environments", "methods", "seeds"}, {"environments", "methods", "seeds", "teachers", "set"}
        if not needed <= set(block) <= known:
            raise ValueError(f"runs[{number}]={dict(block)}: expected {sorted(needed)}, and of {sorted(known)} only.")
        for seed in _seeds(block["seeds"]):
            for env in block["environments"]:
                for label, settings in block["methods"].items():
                    for teacher in block.get("teachers", ["none"]):
                        run = _run(cfg, block, env, teacher, label, settings or {}, seed)
                        found.setdefault(run.key, run)
    return list(found.values())


def _seeds(seeds: Any) -> Sequence[int]:
    """A list of seeds, or ``{first: 200, number: 8}``."""
    if isinstance(seeds, Mapping):
        return range(seeds["first"], seeds["first"] + seeds["number"])
    return list(seeds)


def _run(
    cfg: StudyConfig, block: Mapping, env: str, teacher: str, label: str, settings: Mapping, seed: int
) -> StudyRun:
    if teacher != "none" and teacher not in cfg.teachers:
        raise ValueError(f"teachers={teacher}: expected one of {', '.join(cfg.teachers)}.")
    advice = {} if teacher == "none" else cfg.teachers[teacher]
    chosen = {"method": label.split()[0]} | dict(cfg.set) | dict(block.get("set") or {}) | dict(advice) | dict(settings)
    overrides = [f"env={env}", f"seed={seed}"]
    overrides += [f"{name}={str(value).format(env=env)}" for name, value in chosen.items()]
    if label != chosen["method"]:
        overrides.append(f"label='{label}'")
    folder = Path(cfg.work) / env / f"{label.replace(' ', '-').replace('=', '')}-{teacher}-{seed}"
    overrides.append("out='{}'".format(str(folder.resolve()).replace("'", "\\'")))  # Hydra reads ω in quotes only
    return StudyRun((env, teacher, label, seed), tuple(overrides), folder)


class Tables:
    """What is known of finished runs; every change is written at once, whole or not at all."""

    def __init__(self, out: Path, name: str) -> None:
        self.files = {kind: out / f"{name}{kind}.csv" for kind in ("", "_training", "_trials", "_teachers")}
        self.rows = {
            kind: pd.read_csv(file, float_precision="round_trip") if file.exists() else pd.DataFrame()
            for kind, file in self.files.items()
        }

    def finished(self) -> set[tuple]:
        """The keys of the runs that are there."""
        evaluations = self.rows[""]
        return set() if evaluations.empty else set(evaluations[KEY].itertuples(index=False, name=None))

    def add(self, run: StudyRun) -> float:
        """Take a finished run in; its last return."""
        key = dict(zip(KEY, run.key, strict=True))
        evaluations = pd.read_csv(run.folder / "eval.csv", float_precision="round_trip")
        columns = {"frames": "frames", "mean_return": "return", "std_return": "std", "episodes": "episodes"}
        metrics = pd.read_csv(run.folder / "metrics.csv", float_precision="round_trip")
        if "arm" in metrics:  # of a trial: those of the student who won it
            metrics = metrics[metrics["arm"] == json.loads((run.folder / "status.json").read_text())["arm"]]
        kept = [name for name in TRAINING if name in metrics and metrics[name].notna().any()]
        new = {
            "": evaluations[list(columns)].rename(columns=columns),
            "_training": pd.DataFrame(
                {
                    "metric": kept,
                    "mean": [metrics[name].mean() for name in kept],
                    "std": [metrics[name].std(ddof=0) for name in kept],
                    "rollouts": len(metrics),
                }
            ),
            "_trials": pd.DataFrame(),
        }
        if (run.folder / "trials.json").exists():
            trials = json.loads((run.folder / "trials.json").read_text())
            rows = [trial | {"frames": sum(trial["frames"].values())} for trial in trials]
            new["_trials"] = pd.DataFrame(rows)[list(TRIAL)]
        for kind, table in new.items():
            if len(table):
                self.rows[kind] = pd.concat([self.rows[kind], table.assign(**key)[[*KEY, *table]]], ignore_index=True)
                self._write(kind)
        return float(evaluations["mean_return"].iloc[-1])

    def add_teachers(self, runs: Sequence[StudyRun]) -> None:
        """Note the return of each teacher that is used as it is, as its file says."""
        known = {} if self.rows["_teachers"].empty else dict(self.rows["_teachers"].groupby(KEY[:2])["return"].first())
        for run in runs:
            given = dict(override.split("=", 1) for override in run.overrides)
            file = Path(given.get("prior.path", ""))
            if file.is_file() and "prior.degrade" not in given:
                evaluation = read_manifest(file).evaluation
                if "mean_return" in evaluation:
                    known[run.key[:2]] = float(evaluation["mean_return"])
        if known:
            self.rows["_teachers"] = pd.DataFrame([(*key, value) for key, value in known.items()])
            self.rows["_teachers"].columns = pd.Index([*KEY[:2], "return"])
            self._write("_teachers")

    def _write(self, kind: str) -> None:
        keys = [name for name in KEY if name in self.rows[kind]]
        ordered = self.rows[kind].sort_values(keys, kind="stable", ignore_index=True)
        self.files[kind].parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.files[kind], ordered.to_csv(index=False).encode())


def is_finished(folder: Path) -> bool:
    """Whether a run says so itself."""
    try:
        return bool(json.loads((folder / "status.json").read_text())["state"] == "finished")
    except (OSError, ValueError, KeyError):
        return False


def run_missing(missing: Sequence[StudyRun], tables: Tables, workers: int) -> list[str]:
    """Run what is missing, each in a process of its own, some at a time; what failed, with its last words."""
    waiting, failed, done = list(missing), [], 0
    at_work: dict[StudyRun, tuple[subprocess.Popen, float]] = {}
    try:
        while waiting or at_work:
            while waiting and len(at_work) < workers:
                run = waiting.pop(0)
                at_work[run] = (_start(run), time.monotonic())
            for run, (process, start) in [*at_work.items()]:
                if process.poll() is None:
                    continue
                del at_work[run]
                done += 1
                progress = f"{done} of {len(missing)}: {run}, {time.monotonic() - start:.0f} s"
                if process.returncode == 0 and is_finished(run.folder):
                    print(f"{progress}, return {tables.add(run):.1f}", flush=True)
                else:
                    failed.append(f"{run}: {_last_words(run, process.returncode)}")
                    print(f"{progress}, failed", flush=True)
            time.sleep(0.2)
    finally:
        for process, _ in at_work.values():
            process.terminate()
    return failed


def _start(run: StudyRun) -> subprocess.Popen:
    run.folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "recipes.mujoco", *run.overrides]
    with (run.folder / "log.txt").open("w") as log:
        return subprocess.Popen(
            command,
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            preexec_fn=end_with_parent,  # a study that goes on would find them at work
        )


def _last_words(run: StudyRun, code: int) -> str:
    lines = (run.folder / "log.txt").read_text(errors="replace").replace("\r", "\n").strip().splitlines()
    return f"exit status {code}: {lines[-1] if lines else 'nothing was printed'} (see {run.folder / 'log.txt'})"


def summary(runs: Sequence[StudyRun], finished: set[tuple]) -> Iterator[str]:
    """How many runs of each environment are done."""
    for env in dict.fromkeys(run.key[0] for run in runs):
        keys = [run.key for run in runs if run.key[0] == env]
        yield f"{env}: {sum(key in finished for key in keys)} of {len(keys)} runs are in the tables"


def study(cfg: StudyConfig) -> None:
    """Say what is missing, and run it.

    Raises:
        ValueError: bad input, or runs that failed; the message names them.
    """
    check_keys(cfg)
    runs, tables = expand(cfg), Tables(Path(cfg.out), cfg.name)
    for run in runs:
        if run.key not in tables.finished() and is_finished(run.folder):
            tables.add(run)
    tables.add_teachers(runs)
    for line in summary(runs, tables.finished()):
        print(line, flush=True)
    if not cfg.run:
        return
    missing = [run for run in runs if run.key not in tables.finished()]
    if failed := run_missing(missing, tables, cfg.workers):
        raise ValueError("\n".join([f"{len(failed)} of {len(missing)} runs failed:", *failed]))


@hydra.main(version_base="1.3", config_path="../conf", config_name="mujoco_study")
def main(cfg: StudyConfig) -> None:
    """Run a study."""
    OmegaConf.resolve(cfg)  # type: ignore[arg-type]
    try:
        study(cfg)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"Error: {error}")


if __name__ == "__main__":
    start(main, "mujoco_study")
