"""What a MuJoCo run may be configured with: names and types here, defaults in ``conf/mujoco.yaml`` and ``conf/env``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

import recipes.common.sweeps  # noqa: F401  registers the launcher that conf/mujoco.yaml names
from recipes.common.checks import check_keys, require_compiler
from recipes.common.loggers import LOGGERS, require_logger
from recipes.common.schedules import ScheduleConfig, check_schedule
from torchrl_priors.methods import MethodSpec, get_method

__all__ = ["ALONE", "MujocoConfig", "check", "method_of", "require", "teachers"]

ALONE = "alone"
"""The student of a trial that has no teacher."""


@dataclass
class Env:
    """The task, and what is tuned to it."""

    id: str = MISSING
    version: str = MISSING
    num_envs: int = MISSING
    frames_per_batch: int = MISSING
    minibatch_size: int = MISSING
    total_frames: int = MISSING
    degrade_feature: int = MISSING
    degrade_threshold: float = MISSING
    kwargs: dict[str, Any] = field(default_factory=dict)


@dataclass
class Prior:
    """The teacher."""

    path: Any = MISSING
    degrade: str = MISSING
    feature: int = MISSING
    threshold: float = MISSING
    prob: float = MISSING


@dataclass
class Weight:
    """The prior weight."""

    lr_coeff: float = MISSING
    init_bias: float = MISSING
    trained: str = MISSING
    epochs: int = MISSING


@dataclass
class Trial:
    """How it is found out whether a teacher helps."""

    method: str = MISSING
    max_frames: int = MISSING
    min_frames: int = MISSING
    alpha: float = MISSING
    recent: float = MISSING


@dataclass
class LetGo:
    """When a teacher that helped is let go."""

    methods: str = MISSING
    window: int = MISSING


@dataclass
class PPO:
    """The base algorithm."""

    epochs: int = MISSING
    clip_epsilon: float = MISSING
    lr: float = MISSING
    adam_eps: float = MISSING
    gamma: float = MISSING
    gae_lambda: float = MISSING
    entropy_coeff: float = MISSING
    max_grad_norm: float = MISSING
    hidden: list[int] = MISSING


@dataclass
class Evaluation:
    """When and how the frozen policy is evaluated."""

    interval: int = MISSING
    episodes: int = MISSING


@dataclass
class Checkpoints:
    """What an interruption costs."""

    interval: int = MISSING
    keep: int = MISSING


@dataclass
class MujocoConfig:
    """The whole configuration of ``python -m recipes.mujoco``."""

    env: Env = field(default_factory=Env)
    method: str = MISSING
    seed: int = MISSING
    total_frames: int = MISSING
    prior: Prior = field(default_factory=Prior)
    weight: Weight = field(default_factory=Weight)
    trial: Trial = field(default_factory=Trial)
    let_go: LetGo = field(default_factory=LetGo)
    cross_entropy: str | None = MISSING
    td_error: str = MISSING
    centering: str = MISSING
    bonus_coeff: float = MISSING
    aux_coeff: float | None = MISSING
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    ppo: PPO = field(default_factory=PPO)
    evaluation: Evaluation = field(default_factory=Evaluation)
    checkpoint: Checkpoints = field(default_factory=Checkpoints)
    compile: bool = MISSING
    resume: bool = MISSING
    logger: str = MISSING
    out: str | None = MISSING


ConfigStore.instance().store(group="schema", name="mujoco", node=MujocoConfig, package="_global_")


def teachers(cfg: MujocoConfig) -> list[Path]:
    """The teachers' files."""
    path = cfg.prior.path
    several = path if isinstance(path, Sequence) and not isinstance(path, str) else [path]
    return [] if path is None else [Path(str(one)).expanduser() for one in several]


def method_of(cfg: MujocoConfig) -> MethodSpec:
    """What is done with the teacher: the settings of the method, or of that which a trial tries.

    Raises:
        ValueError: there is no such method.
    """
    spec = get_method(cfg.trial.method if cfg.method == "trial" else cfg.method)
    return spec if cfg.cross_entropy is None else replace(spec, cross_entropy=cfg.cross_entropy)  # type: ignore[arg-type]


def require(holds: bool, key: str, value: Any, expected: str) -> None:
    """Refuse the value of a key.

    Raises:
        ValueError: it does not hold; names the key, its value and what was expected.
    """
    if not holds:
        raise ValueError(f"{key}={value}: expected {expected}.")


def check(cfg: MujocoConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
        ImportError: names the extra that is needed.
    """
    check_keys(cfg)
    spec = method_of(cfg)
    files = teachers(cfg)
    if cfg.method == "trial":
        _check_arms(cfg, files)
    elif cfg.method != "none":
        expected = "the file of a teacher" if not files else "one teacher; method=trial takes several"
        require(len(files) == 1, "prior.path", cfg.prior.path, f"{expected}, as method={cfg.method} has one")
    if cfg.method == "trial" or cfg.let_go.methods == "all":
        _check_trial(cfg)
    options = {
        "td_error": (cfg.td_error, ("original", "shaped")),
        "centering": (cfg.centering, ("none", "prior", "policy")),
        "prior.degrade": (cfg.prior.degrade, ("none", "structural", "random")),
        "weight.trained": (cfg.weight.trained, ("minibatch", "rollout", "oracle")),
        "let_go.methods": (cfg.let_go.methods, ("trial", "all", "none")),
        "cross_entropy": (cfg.cross_entropy, (None, "student", "teacher")),
        "logger": (cfg.logger, LOGGERS),
    }
    for key, (choice, allowed) in options.items():
        require(choice in allowed, key, choice, f"one of {', '.join(map(str, allowed))}")
    check_schedule(cfg.schedule)
    if spec.relative:
        require(cfg.centering == "none", "centering", cfg.centering, f"none, as method={cfg.method} is not centred")
    positive = {
        "total_frames": cfg.total_frames,
        "env.num_envs": cfg.env.num_envs,
        "env.frames_per_batch": cfg.env.frames_per_batch,
        "env.minibatch_size": cfg.env.minibatch_size,
        "ppo.epochs": cfg.ppo.epochs,
        "ppo.lr": cfg.ppo.lr,
        "ppo.clip_epsilon": cfg.ppo.clip_epsilon,
        "ppo.adam_eps": cfg.ppo.adam_eps,
        "ppo.max_grad_norm": cfg.ppo.max_grad_norm,
        "weight.epochs": cfg.weight.epochs,
        "let_go.window": cfg.let_go.window,
        "evaluation.interval": cfg.evaluation.interval,
        "evaluation.episodes": cfg.evaluation.episodes,
        "checkpoint.interval": cfg.checkpoint.interval,
        "checkpoint.keep": cfg.checkpoint.keep,
    }
    for key, value in positive.items():
        require(0 < value < float("inf"), key, value, "a positive number")
    at_least_0 = {
        "seed": cfg.seed,
        "bonus_coeff": cfg.bonus_coeff,
        "aux_coeff": 0.0 if cfg.aux_coeff is None else cfg.aux_coeff,
        "weight.lr_coeff": cfg.weight.lr_coeff,
        "ppo.entropy_coeff": cfg.ppo.entropy_coeff,
    }
    for key, value in at_least_0.items():
        require(0 <= value < float("inf"), key, value, "a number of at least 0")
    require(cfg.seed < 2**32, "seed", cfg.seed, "a number below 2**32")
    finite = {"weight.init_bias": cfg.weight.init_bias, "prior.threshold": cfg.prior.threshold}
    for key, value in finite.items():
        require(math.isfinite(value), key, value, "a finite number")
    shares = {"ppo.gamma": cfg.ppo.gamma, "ppo.gae_lambda": cfg.ppo.gae_lambda, "prior.prob": cfg.prior.prob}
    for key, value in shares.items():
        require(0 <= value <= 1, key, value, "a number in [0, 1]")
    require(len(cfg.ppo.hidden) > 0 and min(cfg.ppo.hidden) > 0, "ppo.hidden", cfg.ppo.hidden, "positive sizes")
    if cfg.weight.trained == "oracle":
        degrade = cfg.prior.degrade
        require(
            degrade == "structural", "prior.degrade", degrade, "structural, as weight.trained=oracle knows no other"
        )
    batch, frames = cfg.env.frames_per_batch, cfg.total_frames
    envs, size = cfg.env.num_envs, cfg.env.minibatch_size
    require(batch % envs == 0, "env.frames_per_batch", batch, f"a multiple of env.num_envs={envs}")
    require(batch % size == 0, "env.minibatch_size", size, f"a divisor of env.frames_per_batch={batch}")
    near = max(1, round(frames / batch)) * batch
    expected = f"a multiple of env.frames_per_batch={batch}, such as {near}"
    require(frames % batch == 0, "total_frames", frames, expected)
    require_logger(cfg.logger)
    if find_spec("safetensors") is None:  # found missing when the policy is saved, it would cost the run
        raise ImportError(
            "safetensors is missing, and the policy is saved by it: pip install 'torchrl-priors[recipes]'."
        )
    require_compiler(cfg.compile)


def _check_arms(cfg: MujocoConfig, files: Sequence[Path]) -> None:
    arms, method = len(files) + 1, cfg.trial.method
    require(bool(files), "prior.path", cfg.prior.path, "the files of one or more teachers, as method=trial tries them")
    names = [file.stem for file in files]
    require(len({*names, ALONE}) == arms, "prior.path", cfg.prior.path, f"files of different names, none {ALONE!r}")
    require(method != "none", "trial.method", method, "a method with a teacher")
    batch = cfg.env.frames_per_batch
    least = arms * (-(-cfg.trial.max_frames // batch)) * batch
    frames, expected = cfg.total_frames, f"at least {least}, for a trial of {arms} students"
    require(frames >= least, "total_frames", frames, expected)


def _check_trial(cfg: MujocoConfig) -> None:
    trial, batch = cfg.trial, cfg.env.frames_per_batch
    most = trial.max_frames
    require(most >= batch, "trial.max_frames", most, f"at least one rollout of {batch}")
    require(0 <= trial.min_frames <= most, "trial.min_frames", trial.min_frames, f"a number from 0 to {most}")
    require(0 < trial.alpha < 1, "trial.alpha", trial.alpha, "a number between 0 and 1")
    require(0 < trial.recent <= 1, "trial.recent", trial.recent, "a share above 0 and up to 1")
