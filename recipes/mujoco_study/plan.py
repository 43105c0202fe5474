"""The runs that a study's configuration stands for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from recipes.common.checks import positive

__all__ = ["ROOT", "StudyConfig", "StudyRun", "expand"]

ROOT = Path(__file__).parents[2]
_NEEDED, _KNOWN = {"environments", "methods", "seeds"}, {"environments", "methods", "seeds", "teachers", "makes", "set"}


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
        teacher: the file of its teacher, if it has one.
        degraded: whether its teacher is made worse on purpose.
        makes: the file that the best of such runs becomes, if any.
    """

    key: tuple[str, str, str, int]
    overrides: tuple[str, ...]
    folder: Path
    teacher: Path | None = None
    degraded: bool = False
    makes: Path | None = None

    @property
    def settings(self) -> str:
        """What it has in common with the runs of other seeds: its overrides but for seed and folder."""
        return " ".join(one for one in self.overrides if not one.startswith(("seed=", "out=")))

    def __str__(self) -> str:
        """For a line of progress."""
        env, teacher, method, seed = self.key
        return f"{env} {method} {teacher} seed {seed}"


def expand(cfg: StudyConfig) -> list[StudyRun]:
    """The runs that the configuration stands for, in its order, seed by seed.

    Raises:
        ValueError: an unknown teacher, a block that lacks an entry or has one too many or a wrong one, or a run with
            two settings; the message names it.
    """
    found: dict[tuple, StudyRun] = {}
    for number, block in enumerate(cfg.runs):
        if not _NEEDED <= set(block) <= _KNOWN:
            raise ValueError(f"runs[{number}]={dict(block)}: expected {sorted(_NEEDED)}, and of {sorted(_KNOWN)} only.")
        _check(f"runs[{number}]", block)
        for seed in _seeds(block["seeds"]):
            for env in block["environments"]:
                for label, settings in block["methods"].items():
                    for teacher in block.get("teachers", ["none"]):
                        run = _run(cfg, block, env, teacher, label, settings or {}, seed)
                        if found.setdefault(run.key, run).overrides != run.overrides:
                            raise ValueError(f"runs[{number}]: {run} is there with other settings already.")
    return list(found.values())


def _check(name: str, block: Mapping) -> None:
    """Refuse a block whose entries are of another kind."""
    for key in ("environments", "teachers"):
        if isinstance(block.get(key, []), str | Mapping):
            raise ValueError(f"{name}.{key}={block[key]}: expected a list.")
    if not isinstance(block["methods"], Mapping):
        raise ValueError(f"{name}.methods={block['methods']}: expected settings by method.")
    seeds = block["seeds"]
    if set(seeds) != {"first", "number"} if isinstance(seeds, Mapping) else isinstance(seeds, int | str):
        raise ValueError(f"{name}.seeds={seeds}: expected a list, or first and number.")


def _seeds(seeds: Any) -> Sequence[int]:
    """A list of seeds, or ``{first: 200, number: 8}``."""
    if isinstance(seeds, Mapping):
        return range(seeds["first"], seeds["first"] + seeds["number"])
    return list(seeds)


def _run(
    cfg: StudyConfig, block: Mapping, env: str, teacher: str, label: str, settings: Mapping, seed: int
) -> StudyRun:
    advice = {} if teacher == "none" else _teacher(cfg, teacher, env)
    chosen = {"method": label.split()[0]} | dict(cfg.set) | dict(block.get("set") or {}) | advice | dict(settings)
    overrides = [
        f"env={env}",
        f"seed={seed}",
        *(f"{name}={'null' if value is None else value}" for name, value in chosen.items()),
    ]
    if label != chosen["method"]:
        overrides.append(f"label='{label}'")
    folder = Path(cfg.work) / env / f"{label.replace(' ', '-').replace('=', '')}-{teacher}-{seed}"
    overrides.append("out='{}'".format(str(folder.resolve()).replace("'", "\\'")))  # Hydra reads ω in quotes only
    return StudyRun(
        (env, teacher, label, seed),
        tuple(overrides),
        folder,
        teacher=ROOT / chosen["prior.path"] if "prior.path" in chosen else None,
        degraded="prior.degrade" in chosen,
        makes=ROOT / _teacher(cfg, block["makes"], env)["prior.path"] if "makes" in block else None,
    )


def _teacher(cfg: StudyConfig, name: str, env: str) -> dict[str, str]:
    """What a run is told of its teacher."""
    if name not in cfg.teachers:
        raise ValueError(f"teachers={name}: expected one of {', '.join(cfg.teachers)}.")
    return {key: str(value).format(env=env) for key, value in cfg.teachers[name].items()}
