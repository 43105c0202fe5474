"""Runs found and read for a report, told apart by environment, prior and method; what cannot be used, and why not."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from omegaconf import OmegaConf

from recipes.common.run_folder import RunFolder, flatten
from torchrl_priors.methods import METHODS, MethodSpec, get_method

__all__ = [
    "FinishedRun",
    "LeftOut",
    "find",
    "is_gridworld",
    "method_order",
    "name_priors",
    "read",
    "short_paths",
    "without_misfits",
]


@dataclass
class FinishedRun:
    """A finished run whose data are whole."""

    path: Path
    env: str
    degrade: str  # how its prior is degraded, "none" if it isn't, "" without a prior
    method: str
    seed: int
    settings: dict[str, Any]
    evaluations: pd.DataFrame
    metrics: pd.DataFrame
    within: dict[str, float] = field(default_factory=dict)  # where metrics are means: their spread within the run
    teacher_return: float | None = None
    prior: str = ""  # how it is called; "" without one
    label: str = ""  # what it is called: its method if it says nothing else

    @property
    def degraded(self) -> bool:
        """Whether its prior is made worse on purpose."""
        return self.degrade not in ("", "none")


@dataclass(frozen=True)
class LeftOut:
    """A run that is in no table and no figure."""

    path: Path
    reason: str


#: What runs of one label may differ in; and what those without a teacher, and those without a weight, do not read.
_INCIDENTAL = ["seed", "out", "label", "evaluation.*", "checkpoint.*", "resume", "logger", "compile", "total_frames"]
_INCIDENTAL += [f"prior.{name}" for name in ("path", "degrade", "feature", "threshold", "prob", "trust_code")]  # named
_OF_WEIGHTS = ["weight.*", "td_error"]
_OF_TEACHERS = [
    *_OF_WEIGHTS,
    "prior.*",
    "bonus_coeff",
    "aux_coeff",
    "cross_entropy",
    "schedule.*",
    "trial.*",
    "let_go.*",
]


class _UnusableError(Exception):
    """Why a run is left out."""


def find(runs: Any) -> list[Path]:
    """The folders of runs that a folder, a glob or a list of those stands for, each once.

    Raises:
        ValueError: nothing is there; the message names what was looked for.
    """
    patterns = [runs] if isinstance(runs, str) else list(runs)
    found: list[Path] = []
    for pattern in patterns:
        below = [path for name in sorted(glob(str(pattern), recursive=True)) for path in _below(Path(name))]
        if not below:
            raise ValueError(
                f"runs={pattern}: no folder with a config.yaml or a status.json, and no study's CSV, is there."
            )
        found += below
    return list(dict.fromkeys(found))


def _below(folder: Path) -> list[Path]:
    if folder.suffix == ".csv" and folder.is_file():  # of a study
        return [folder]
    files = [folder / name for name in ("config.yaml", "status.json")] if folder.is_dir() else []
    if any(file.exists() for file in files):
        return [folder]
    inner = {file.parent for name in ("config.yaml", "status.json") for file in folder.rglob(name)}
    return sorted(path for path in inner if not any(part.startswith(".") for part in path.relative_to(folder).parts))


def is_gridworld(folder: Path) -> bool:
    """Whether ``recipes.gridworld`` wrote the folder."""
    if (folder / "area_ratio.csv").exists():
        return True
    config = folder / "config.yaml"
    return not (folder / "status.json").exists() and config.is_file() and b"\nworlds:" in b"\n" + config.read_bytes()


def read(folders: Iterable[Path]) -> tuple[list[FinishedRun], list[LeftOut]]:
    """The runs in their folders, and those that are not to be used."""
    results = [_read(folder) for folder in folders]
    runs = [result for result in results if isinstance(result, FinishedRun)]
    return runs, [result for result in results if isinstance(result, LeftOut)]


def _read(folder: Path) -> FinishedRun | LeftOut:
    try:
        return _read_whole(folder)
    except _UnusableError as reason:
        return LeftOut(folder, str(reason))


def _read_whole(folder: Path) -> FinishedRun:
    arm = _check_finished(folder).get("arm")
    try:
        # as it is: what another's file has in ${...} could be a secret of this machine, and the report is published
        config: Any = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
        method, seed, env = str(config["method"]), int(config["seed"]), env_name(config["env"])
        auxiliary = spec_of(method, config).auxiliary and method != "trial"  # whose winner may have no teacher
    except FileNotFoundError:
        raise _UnusableError("config.yaml is missing") from None
    except Exception as error:  # whatever reading a damaged file ends in
        raise _UnusableError(f"config.yaml cannot be used ({type(error).__name__}: {error})") from None
    needed = ["frames", "loss_objective", "entropy"] + ["loss_prior"] * auxiliary
    return FinishedRun(
        path=folder,
        env=env,
        degrade="" if method == "none" else str((config.get("prior") or {}).get("degrade") or "none"),
        method=method,
        seed=seed,
        label=str(config.get("label") or method),
        settings=flatten(config) | _digest_of_teacher(folder / "config.json"),
        evaluations=_table(folder / "eval.csv", ["frames", "mean_return"], optional=()),
        metrics=_table(folder / "metrics.csv", needed, optional=("episode*", "aux_coeff", "bonus_coeff"), arm=arm),
        teacher_return=_teacher_return(folder / "teacher.json"),
    )


def _digest_of_teacher(file: Path) -> dict[str, str]:
    """Of its file's content, which may have changed under one path; older runs have none."""
    try:
        return {"prior.sha256": str(json.loads(file.read_text())["prior"]["sha256"])}
    except (ValueError, TypeError, KeyError, OSError):
        return {}


def _teacher_return(file: Path) -> float | None:
    """The own return of a run's teacher; None of a run without one or with several."""
    if not file.exists():
        return None
    try:
        (teacher, *others) = json.loads(file.read_text())["teachers"].values()
        return None if others else float(teacher["mean_return"])
    except (ValueError, TypeError, KeyError, AttributeError, OSError):
        raise _UnusableError("teacher.json is damaged") from None


def _check_finished(folder: Path) -> dict[str, Any]:
    """What the run says of itself."""
    try:
        status = json.loads((folder / "status.json").read_text())
        state = status["state"]
    except FileNotFoundError:
        raise _UnusableError("status.json is missing") from None
    except (ValueError, TypeError, KeyError, OSError):
        raise _UnusableError("status.json is damaged") from None
    if state == "failed":
        raise _UnusableError(f"it failed: {status.get('error') or 'no reason given'}")
    if state in ("running", "interrupted") and not RunFolder.is_at_work(folder):
        frames = status.get("frames", "unknown")
        raise _UnusableError(f"it is not finished: broken off after {frames} frames, and continued by the same command")
    if state != "finished":
        raise _UnusableError(f"it is not finished (state {state}, {status.get('frames', 'unknown')} frames)")
    return dict(status)


def _table(file: Path, needed: Sequence[str], optional: Sequence[str], arm: str | None = None) -> pd.DataFrame:
    """A CSV whose needed columns are there, and without a hole in any column that isn't off (empty) as a whole."""
    try:
        table = pd.read_csv(file)
    except FileNotFoundError:
        raise _UnusableError(f"{file.name} is missing") from None
    except (ValueError, OSError) as error:
        raise _UnusableError(f"{file.name} is damaged ({error})") from None
    if absent := [name for name in needed if name not in table]:
        raise _UnusableError(f"{file.name} has no column {', '.join(absent)}")
    if table.empty:
        raise _UnusableError(f"{file.name} has no rows")
    if "arm" in table:  # of a trial: the rows of the student who won it
        table = table[table["arm"] == arm].drop(columns="arm").reset_index(drop=True)
    for name in table.columns:
        values = pd.to_numeric(table[name], errors="coerce")
        bad = ~np.isfinite(values.to_numpy(dtype=np.float64))
        off = bad.all() and name not in needed and table[name].isna().all()
        if bad.any() and not off and not any(fnmatchcase(name, pattern) for pattern in optional):
            where = "" if name == "frames" else f", first at {table['frames'][int(bad.argmax())]:g} frames"
            raise _UnusableError(f"{file.name} has {int(bad.sum())} values of {name} that are not finite{where}")
        table[name] = values
    if not table["frames"].is_monotonic_increasing or table["frames"].duplicated().any():
        raise _UnusableError(f"frames in {file.name} do not increase")
    return table


def env_name(node: Any) -> str:
    """The name of an environment with its version, from the group ``env`` or a plain name."""
    if not isinstance(node, dict):
        return str(node)
    name, version = str(node["id"]), node.get("version")
    name = name if version is None or name.endswith(f"-{version}") else f"{name}-{version}"
    changed = ", ".join(f"{key}={value}" for key, value in (node.get("kwargs") or {}).items())
    return f"{name} ({changed})" if changed else name


def spec_of(method: str, settings: Mapping[str, Any]) -> MethodSpec:
    """The settings of a run's method, or of that which its trial tries."""
    tried = settings.get("trial.method") or (settings.get("trial") or {}).get("method", "none")
    return get_method(str(tried) if method == "trial" else method)


def name_priors(runs: Sequence[FinishedRun]) -> None:
    """Name each run's prior: by how it is degraded and, where runs of one environment have several, by its file."""
    taught = [run for run in runs if run.degrade]
    files = short_paths(Path(str(run.settings.get("prior.path"))).with_suffix("") for run in taught)
    details = {
        "path": lambda run: files[Path(str(run.settings.get("prior.path"))).with_suffix("")],
        "feature": lambda run: f"feature={run.settings.get('prior.feature')}",
        "threshold": lambda run: f"threshold={run.settings.get('prior.threshold')}",
        "prob": lambda run: f"prob={run.settings.get('prior.prob')}",
    }
    meaningful = {"structural": ("path", "feature", "threshold"), "random": ("path", "prob")}
    for run in taught:
        alike = [other for other in taught if (other.env, other.degrade) == (run.env, run.degrade)]
        told = [details[name] for name in meaningful.get(run.degrade, ("path",))]
        kind = f"degraded teacher ({run.degrade})" if run.degraded else "teacher"
        run.prior = ", ".join([kind, *(tell(run) for tell in told if len({tell(other) for other in alike}) > 1)])


def short_paths(paths: Iterable[Path]) -> dict[Path, str]:
    """Names of files or folders by as few of their last folders as tell them apart."""
    different = set(paths)
    depth = 1
    while len({path.parts[-depth:] for path in different}) < len(different):
        depth += 1
    return {path: "/".join(path.parts[-depth:]) for path in different}


def _settings(run: FinishedRun) -> dict[str, Any]:
    """The settings that runs of one label share: all that matter to their results, but for seed and environment."""
    idle = list(_INCIDENTAL)
    if run.method == "none":
        idle += _OF_TEACHERS
    elif not spec_of(run.method, run.settings).adaptive:
        idle += _OF_WEIGHTS
    return {key: value for key, value in run.settings.items() if not any(fnmatchcase(key, name) for name in idle)}


def _difference(settings: dict[str, Any], usual: dict[str, Any]) -> str:
    """The first setting that is another one; nothing if there is none."""
    for key in sorted(settings.keys() | usual.keys()):
        if key in settings and key in usual and settings[key] != usual[key]:  # else one is older than the key
            return f"its {key}={settings[key]} is not the {usual[key]}"
    return ""


def without_misfits(runs: Sequence[FinishedRun]) -> tuple[list[FinishedRun], list[LeftOut]]:
    """The runs that can be averaged: one per seed, like most of their label, evaluated when most are; in order."""
    grids = {
        env: Counter(tuple(run.evaluations["frames"]) for run in runs if run.env == env).most_common(1)[0][0]
        for env in {run.env for run in runs}
    }
    usual: dict[tuple[str, str, str], list[dict[str, Any]]] = defaultdict(list)
    for run in runs:
        usual[run.env, run.prior, run.label].append(_settings(run))
    kept: dict[tuple[str, str, str, int], FinishedRun] = {}
    left_out = []
    for run in runs:
        grid = grids[run.env]
        key = (run.env, run.prior, run.label, run.seed)
        if tuple(run.evaluations["frames"]) != grid:
            own = run.evaluations["frames"]
            left_out.append(
                LeftOut(
                    run.path,
                    f"it was evaluated {len(own)} times up to {own.iloc[-1]:g} frames, most runs in {run.env} "
                    f"{len(grid)} times up to {grid[-1]:g}",
                )
            )
        elif different := _difference(_settings(run), max(same := usual[key[:3]], key=same.count)):
            left_out.append(LeftOut(run.path, f"{different} of most runs called {run.label!r}: give it a label"))
        elif key in kept:
            left_out.append(LeftOut(run.path, f"it repeats {kept[key].path} (same method, prior and seed)"))
        else:
            kept[key] = run
    usable = sorted(kept.values(), key=lambda run: (run.env, run.degraded, run.prior, method_order(run), run.seed))
    return usable, left_out


def method_order(run: FinishedRun) -> tuple[int, list[float], str]:
    """Methods in their order, and the settings of one from the largest to the smallest."""
    numbers = re.findall(r"\d+\.?\d*", run.label.partition(" ")[2])
    return [*METHODS, "trial"].index(run.method), [-float(number) for number in numbers], run.label
