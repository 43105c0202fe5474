"""What a gridworld study may be configured with: names and types here, defaults in ``conf/gridworld.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, field

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from recipes.common.checks import at_least_0, check_keys, one_of, positive, require, share
from recipes.common.schedules import ScheduleConfig, check_schedule
from recipes.gridworld.run_parts import parse_prior
from torchrl_priors.methods import get_method

__all__ = ["GridworldConfig", "check"]


@dataclass
class World:
    """How worlds are sampled and behave."""

    size: int = positive(below=2**31)
    window: int = MISSING
    wall_prob: float = share()
    object_prob: float = share()
    noise: float = share()
    end_prob: float = MISSING


@dataclass
class Teacher:
    """Tabular Q-learning."""

    steps: int = positive(below=2**31)
    gamma: float = share()
    lr: float = positive()
    epsilon: float = share()
    temperature: float = positive()
    eval_episodes: int = positive(below=2**31)


@dataclass
class LrWeight:
    """Learning rate of the prior weight, by what it regresses on."""

    original: float = at_least_0()
    shaped: float = at_least_0()
    advantage: float = at_least_0()


@dataclass
class Student:
    """Tabular actor-critic."""

    gamma: float = share()
    lr: float = positive()
    bonus_coeff: float = at_least_0()
    aux_coeff: float | None = at_least_0()
    cross_entropy: str | None = one_of("student", "teacher")
    lr_weight: LrWeight = field(default_factory=LrWeight)


@dataclass
class Evaluation:
    """When students are evaluated."""

    points: int = positive(below=2**31)
    interval: int = positive(below=2**31)


@dataclass
class Bootstrap:
    """Confidence intervals."""

    reps: int = positive(below=2**31)
    seed: int = at_least_0()


@dataclass
class GridworldConfig:
    """The whole configuration of ``python -m recipes.gridworld``."""

    name: str = MISSING
    worlds: int = positive(below=2**31)
    seed: int = at_least_0(below=2**62)
    td_error: str = one_of("original", "shaped")
    methods: list[str] = MISSING
    priors: list[str] = MISSING
    world: World = field(default_factory=World)
    teacher: Teacher = field(default_factory=Teacher)
    student: Student = field(default_factory=Student)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    evaluation: Evaluation = field(default_factory=Evaluation)
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    workers: int | None = positive(below=2**31)
    block_worlds: int = positive(below=2**31)
    out: str | None = MISSING


ConfigStore.instance().store(group="schema", name="gridworld", node=GridworldConfig, package="_global_")


def check(cfg: GridworldConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
    """
    check_keys(cfg)
    for key, names, parse in (("methods", cfg.methods, get_method), ("priors", cfg.priors, parse_prior)):
        require(len(names) > 0, key, list(names), "at least one")
        require(len(set(names)) == len(names), key, list(names), "no name twice")
        for name in names:
            try:
                parse(name)
            except ValueError as error:
                raise ValueError(f"{key}={list(names)}: {error}") from None
    require("none" in cfg.methods, "methods", list(cfg.methods), "none among them: area ratios compare with it")
    check_schedule(cfg.schedule)
    require(cfg.world.window > 0 and cfg.world.window % 2 == 1, "world.window", cfg.world.window, "an odd number")
    require(
        0 < cfg.world.end_prob <= 1,
        "world.end_prob",
        cfg.world.end_prob,
        "a number in (0, 1], or episodes may never end",
    )
