"""What a gridworld study may be configured with: names and types here, defaults in ``conf/gridworld.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from recipes.common.checks import check_keys
from recipes.common.schedules import ScheduleConfig, check_schedule
from recipes.gridworld.learners import parse_prior
from torchrl_priors.methods import get_method

__all__ = ["GridworldConfig", "check"]


@dataclass
class World:
    """How worlds are sampled and behave."""

    size: int = MISSING
    window: int = MISSING
    wall_prob: float = MISSING
    object_prob: float = MISSING
    noise: float = MISSING
    end_prob: float = MISSING


@dataclass
class Teacher:
    """Tabular Q-learning."""

    steps: int = MISSING
    gamma: float = MISSING
    lr: float = MISSING
    epsilon: float = MISSING
    temperature: float = MISSING
    eval_episodes: int = MISSING


@dataclass
class LrWeight:
    """Learning rate of the prior weight, by what it regresses on."""

    original: float = MISSING
    shaped: float = MISSING
    advantage: float = MISSING


@dataclass
class Student:
    """Tabular actor-critic."""

    gamma: float = MISSING
    lr: float = MISSING
    bonus_coeff: float = MISSING
    aux_coeff: float | None = MISSING
    cross_entropy: str | None = MISSING
    lr_weight: LrWeight = field(default_factory=LrWeight)


@dataclass
class Evaluation:
    """When students are evaluated."""

    points: int = MISSING
    interval: int = MISSING


@dataclass
class Bootstrap:
    """Confidence intervals."""

    reps: int = MISSING
    seed: int = MISSING


@dataclass
class GridworldConfig:
    """The whole configuration of ``python -m recipes.gridworld``."""

    name: str = MISSING
    worlds: int = MISSING
    seed: int = MISSING
    td_error: str = MISSING
    methods: list[str] = MISSING
    priors: list[str] = MISSING
    world: World = field(default_factory=World)
    teacher: Teacher = field(default_factory=Teacher)
    student: Student = field(default_factory=Student)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    evaluation: Evaluation = field(default_factory=Evaluation)
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    workers: int | None = MISSING
    block_worlds: int = MISSING
    out: str | None = MISSING


ConfigStore.instance().store(group="schema", name="gridworld", node=GridworldConfig, package="_global_")


def _require(holds: bool, key: str, value: Any, expected: str) -> None:
    if not holds:
        raise ValueError(f"{key}={value}: expected {expected}.")


def check(cfg: GridworldConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
    """
    check_keys(cfg)
    for key, names, parse in (("methods", cfg.methods, get_method), ("priors", cfg.priors, parse_prior)):
        _require(len(names) > 0, key, list(names), "at least one")
        _require(len(set(names)) == len(names), key, list(names), "no name twice")
        for name in names:
            try:
                parse(name)
            except ValueError as error:
                raise ValueError(f"{key}={list(names)}: {error}") from None
    _require("none" in cfg.methods, "methods", list(cfg.methods), "none among them: area ratios compare with it")
    whose = cfg.student.cross_entropy
    _require(whose in (None, "student", "teacher"), "student.cross_entropy", whose, "student, teacher or null")
    _require(cfg.td_error in ("original", "shaped"), "td_error", cfg.td_error, "original or shaped")
    check_schedule(cfg.schedule)
    positive = {
        "worlds": cfg.worlds,
        "teacher.steps": cfg.teacher.steps,
        "teacher.eval_episodes": cfg.teacher.eval_episodes,
        "evaluation.points": cfg.evaluation.points,
        "evaluation.interval": cfg.evaluation.interval,
        "bootstrap.reps": cfg.bootstrap.reps,
        "block_worlds": cfg.block_worlds,
        "world.size": cfg.world.size,
        "teacher.temperature": cfg.teacher.temperature,
        "workers": 1 if cfg.workers is None else cfg.workers,
    }
    for key, value in positive.items():
        _require(0 < value < 2**31, key, value, "a positive number below 2**31")
    _require(cfg.world.window > 0 and cfg.world.window % 2 == 1, "world.window", cfg.world.window, "an odd number")
    probabilities = {f"world.{name}": cfg.world[name] for name in ("wall_prob", "object_prob", "noise")}  # type: ignore[index]
    probabilities |= {"teacher.epsilon": cfg.teacher.epsilon, "teacher.gamma": cfg.teacher.gamma}
    probabilities |= {"student.gamma": cfg.student.gamma}
    for key, value in probabilities.items():
        _require(0 <= value <= 1, key, value, "a number in [0, 1]")
    _require(
        0 < cfg.world.end_prob <= 1,
        "world.end_prob",
        cfg.world.end_prob,
        "a number in (0, 1], or episodes may never end",
    )
    for key, value in {"teacher.lr": cfg.teacher.lr, "student.lr": cfg.student.lr}.items():
        _require(0 < value < float("inf"), key, value, "a positive number")
    rates = {f"student.lr_weight.{name}": cfg.student.lr_weight[name] for name in ("original", "shaped", "advantage")}  # type: ignore[index]
    rates |= {"student.bonus_coeff": cfg.student.bonus_coeff, "student.aux_coeff": cfg.student.aux_coeff or 0.0}
    for key, value in rates.items():
        _require(0 <= value < float("inf"), key, value, "a number of at least 0")
    _require(0 <= cfg.seed < 2**62, "seed", cfg.seed, "a number in [0, 2**62)")
