"""Doing what is missing of a study: each run in a process of its own, some at a time."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from recipes.common.preemption import end_with_parent
from recipes.common.run_folder import write_file
from recipes.mujoco_study.plan import ROOT, StudyRun
from recipes.mujoco_study.tables import KEY, Tables, own_return

__all__ = ["check_makers", "run_missing", "summary"]


def check_makers(runs: Sequence[StudyRun], tables: Tables) -> None:
    """Refuse to choose from a study's runs and the policy of another one.

    Raises:
        ValueError: the file that the best of some runs becomes is there, and of none of them.
    """
    rows = tables.rows("")
    last = rows.groupby(KEY, sort=False)["return"].last() if len(rows) else {}
    for file in dict.fromkeys(run.makes for run in runs if run.makes is not None):
        makers = [run for run in runs if run.makes == file]
        kinds = {run.key[:3] for run in makers}
        returns = [value for key, value in dict(last).items() if key[:3] in kinds]
        for run in makers:
            if (run.folder / "eval.csv").exists():  # it may have ended, and not be in the tables yet
                returns += pd.read_csv(run.folder / "eval.csv")["mean_return"].tolist()[-1:]
        level = own_return(file) if file.exists() else None
        if file.exists() and (level is None or not any(math.isclose(level, value, rel_tol=1e-6) for value in returns)):
            raise ValueError(
                f"{file} is there, and is the policy of no run of this study, of which the best becomes that file: give"
                " the study's teacher another path, such as 'teachers.good={prior.path:\"outputs/{env}.safetensors\"}'."
            )


def summary(runs: Sequence[StudyRun], tables: Tables) -> Iterator[str]:
    """How many runs of each environment are done, and which teachers are not there."""
    finished = tables.finished()
    for env in dict.fromkeys(run.key[0] for run in runs):
        keys = [run.key for run in runs if run.key[0] == env]
        yield f"{env}: {sum(key in finished for key in keys)} of {len(keys)} runs are in the tables"
    yield from _waiting([run for run in runs if run.key not in finished], runs, finished)


def run_missing(runs: Sequence[StudyRun], tables: Tables, workers: int) -> list[str]:
    """Run what is missing; what failed, with its last words, and what could not start."""
    finished = tables.finished()
    waiting = [run for run in runs if run.key not in finished]
    number, done = len(waiting), 0
    failed: list[str] = []
    at_work: dict[StudyRun, tuple[subprocess.Popen, float]] = {}
    try:
        while True:
            if len(at_work) < workers:
                able = [run for run in waiting if not _obstacle(run, runs, finished)]
                for run in able[: workers - len(at_work)]:
                    waiting.remove(run)
                    at_work[run] = (_start(run), time.monotonic())
            if not at_work:
                return [*failed, *_waiting(waiting, runs, finished)]
            for run, (process, start) in [*at_work.items()]:
                if process.poll() is None:
                    continue
                del at_work[run]
                done += 1
                progress = f"{done} of {number}: {run}, {time.monotonic() - start:.0f} s"
                in_use = {other.teacher for other in runs if other.key in finished}
                try:
                    value = _take_in(run, process.returncode, tables, may_teach=run.makes not in in_use)
                    print(f"{progress}, return {value:.1f}", flush=True)
                    finished.add(run.key)
                except (OSError, ValueError, KeyError) as error:
                    failed.append(f"{run}: {error}")
                    print(f"{progress}, failed", flush=True)
            time.sleep(0.2)
    finally:
        for process, _ in at_work.values():
            process.terminate()


def _obstacle(run: StudyRun, runs: Sequence[StudyRun], finished: set[tuple]) -> str:
    """Why a run cannot start yet: its teacher is not there, or not chosen from all of its candidates."""
    if run.teacher is None:
        return ""
    if absent := [maker for maker in runs if maker.makes == run.teacher and maker.key not in finished]:
        return f"its candidates have not all run, e.g. {absent[0]}; {len(absent)} are missing"
    return "" if run.teacher.is_file() else "no such file"


def _waiting(waiting: Sequence[StudyRun], runs: Sequence[StudyRun], finished: set[tuple]) -> Iterator[str]:
    """How many runs wait for what."""
    obstacles = [(run.teacher, why) for run in waiting if (why := _obstacle(run, runs, finished))]
    for file, why in (known := Counter(obstacles)):
        yield f"runs that wait for prior.path={file}: {known[file, why]} ({why})"


def _start(run: StudyRun) -> subprocess.Popen:
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / "log.txt").open("w") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "recipes.mujoco", *run.overrides],
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            preexec_fn=end_with_parent,  # a study that goes on would find them at work
        )


def _take_in(run: StudyRun, code: int, tables: Tables, *, may_teach: bool) -> float:
    """Keep what a run that has ended leaves, its policy first, if it may teach and is the best so far; its return."""
    status = run.folder / "status.json"
    if code or not status.exists() or json.loads(status.read_text())["state"] != "finished":
        lines = (run.folder / "log.txt").read_text(errors="replace").replace("\r", "\n").strip().splitlines()
        last = lines[-1] if lines else "nothing was printed"
        raise ValueError(f"exit status {code}: {last} (see {run.folder / 'log.txt'})")
    if run.makes is not None and may_teach:
        _keep_better(run.makes, run.folder / "policy.safetensors")
    return tables.add(run)


def _keep_better(teacher: Path, policy: Path) -> None:
    """The paper's teacher is the baseline whose last evaluation is the best over the seeds."""
    before, now = (own_return(file) if file.exists() else None for file in (teacher, policy))
    if before is None or (now is not None and now > before):
        write_file(teacher, policy.read_bytes())
