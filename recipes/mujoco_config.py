"""What a MuJoCo run may be configured with: names and types here, defaults in ``conf/mujoco.yaml`` and ``conf/env``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from tensordict import TensorDict

import recipes.launchers  # noqa: F401  registers the launcher that conf/mujoco.yaml names
from recipes.checks import check_keys, require_compiler
from recipes.loggers import LOGGERS, require_logger
from recipes.schedule_config import ScheduleConfig, check_schedule
from torchrl_priors.artifacts import ArtifactError, load_prior
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.collectors.vector_env import check_vector_env
from torchrl_priors.distributions import cross_entropy
from torchrl_priors.methods import MethodSpec, get_method
from torchrl_priors.networks import make_actor

__all__ = ["ALONE", "MujocoConfig", "check", "method_of", "teachers"]

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


def _require(holds: bool, key: str, value: Any, expected: str) -> None:
    if not holds:
        raise ValueError(f"{key}={value}: expected {expected}.")


def check(cfg: MujocoConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
        ImportError: names the extra that is needed.
    """
    check_keys(cfg)
    method_of(cfg)  # that there is such a method
    files = teachers(cfg)
    if cfg.method == "trial":
        _check_arms(cfg, files)
    elif cfg.method != "none":
        expected = "the file of a teacher" if not files else "one teacher; method=trial takes several"
        _require(len(files) == 1, "prior.path", cfg.prior.path, f"{expected}, as method={cfg.method} has one")
    if cfg.method == "trial" or cfg.let_go.methods == "all":
        _check_trial(cfg)
    options = {
        "td_error": (cfg.td_error, ("original", "shaped")),
        "prior.degrade": (cfg.prior.degrade, ("none", "structural", "random")),
        "weight.trained": (cfg.weight.trained, ("minibatch", "rollout", "oracle")),
        "let_go.methods": (cfg.let_go.methods, ("trial", "all", "none")),
        "cross_entropy": (cfg.cross_entropy, (None, "student", "teacher")),
        "logger": (cfg.logger, LOGGERS),
    }
    for key, (choice, allowed) in options.items():
        _require(choice in allowed, key, choice, f"one of {', '.join(map(str, allowed))}")
    check_schedule(cfg.schedule)
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
        _require(0 < value < float("inf"), key, value, "a positive number")
    at_least_0 = {
        "seed": cfg.seed,
        "bonus_coeff": cfg.bonus_coeff,
        "aux_coeff": 0.0 if cfg.aux_coeff is None else cfg.aux_coeff,
        "weight.lr_coeff": cfg.weight.lr_coeff,
        "ppo.entropy_coeff": cfg.ppo.entropy_coeff,
    }
    for key, value in at_least_0.items():
        _require(0 <= value < float("inf"), key, value, "a number of at least 0")
    _require(cfg.seed < 2**32, "seed", cfg.seed, "a number below 2**32")
    finite = {"weight.init_bias": cfg.weight.init_bias, "prior.threshold": cfg.prior.threshold}
    for key, value in finite.items():
        _require(math.isfinite(value), key, value, "a finite number")
    shares = {"ppo.gamma": cfg.ppo.gamma, "ppo.gae_lambda": cfg.ppo.gae_lambda, "prior.prob": cfg.prior.prob}
    for key, value in shares.items():
        _require(0 <= value <= 1, key, value, "a number in [0, 1]")
    _require(len(cfg.ppo.hidden) > 0 and min(cfg.ppo.hidden) > 0, "ppo.hidden", cfg.ppo.hidden, "positive sizes")
    if cfg.weight.trained == "oracle":
        degrade = cfg.prior.degrade
        _require(
            degrade == "structural", "prior.degrade", degrade, "structural, as weight.trained=oracle knows no other"
        )
    batch, frames = cfg.env.frames_per_batch, cfg.total_frames
    envs, size = cfg.env.num_envs, cfg.env.minibatch_size
    _require(batch % envs == 0, "env.frames_per_batch", batch, f"a multiple of env.num_envs={envs}")
    _require(batch % size == 0, "env.minibatch_size", size, f"a divisor of env.frames_per_batch={batch}")
    near = max(1, round(frames / batch)) * batch
    expected = f"a multiple of env.frames_per_batch={batch}, such as {near}"
    _require(frames % batch == 0, "total_frames", frames, expected)
    require_logger(cfg.logger)
    if find_spec("safetensors") is None:  # found missing when the policy is saved, it would cost the run
        raise ImportError(
            "safetensors is missing, and the policy is saved by it: pip install 'torchrl-priors[recipes]'."
        )
    require_compiler(cfg.compile)
    obs_dim, act_dim = _check_env(cfg)
    for file in files if cfg.method != "none" else ():
        _check_prior(cfg, file, obs_dim, act_dim)


def _check_env(cfg: MujocoConfig) -> tuple[int, int]:
    """Build one environment, so that a wrong name or argument is refused before there is a folder of the run.

    Returns:
        tuple of int: features of its observations, and dimensions of its actions.
    """
    name = f"{cfg.env.id}-{cfg.env.version}"
    try:
        env = make_vector_env(name, 1, **cfg.env.kwargs)
        check_vector_env(env)
        env.close()
        return env.single_observation_space.shape[0], env.single_action_space.shape[0]
    except Exception as error:  # Gymnasium's own, or whatever its environments raise
        if (
            isinstance(error, ImportError) and ":" not in name
        ):  # MuJoCo is not installed; a:b is module a, environment b
            raise
        given = "".join(f", {key}={value}" for key, value in cfg.env.kwargs.items())
        raise ValueError(f"env={name}{given}: cannot be used ({type(error).__name__}: {error}).") from None


def _check_arms(cfg: MujocoConfig, files: Sequence[Path]) -> None:
    arms, method = len(files) + 1, cfg.trial.method
    _require(bool(files), "prior.path", cfg.prior.path, "the files of one or more teachers, as method=trial tries them")
    names = [file.stem for file in files]
    _require(len({*names, ALONE}) == arms, "prior.path", cfg.prior.path, f"files of different names, none {ALONE!r}")
    _require(method != "none", "trial.method", method, "a method with a teacher")
    batch = cfg.env.frames_per_batch
    least = arms * (-(-cfg.trial.max_frames // batch)) * batch
    frames, expected = cfg.total_frames, f"at least {least}, for a trial of {arms} students"
    _require(frames >= least, "total_frames", frames, expected)


def _check_trial(cfg: MujocoConfig) -> None:
    trial, batch = cfg.trial, cfg.env.frames_per_batch
    most = trial.max_frames
    _require(most >= batch, "trial.max_frames", most, f"at least one rollout of {batch}")
    _require(0 <= trial.min_frames <= most, "trial.min_frames", trial.min_frames, f"a number from 0 to {most}")
    _require(0 < trial.alpha < 1, "trial.alpha", trial.alpha, "a number between 0 and 1")
    _require(0 < trial.recent <= 1, "trial.recent", trial.recent, "a share above 0 and up to 1")


def _check_prior(cfg: MujocoConfig, path: Path, obs_dim: int, act_dim: int) -> None:
    """Read a teacher, so that a wrong one is refused before there is a folder of the run."""
    if not path.is_file():
        raise FileNotFoundError(
            f"prior.path={path}: {'a folder, expected a file' if path.is_dir() else 'no such file'}."
        )
    try:
        env_id = f"{cfg.env.id}-{cfg.env.version}"
        prior = load_prior(path, env_id=env_id, observation_spec=obs_dim, action_spec=act_dim)
    except ArtifactError as error:
        raise ValueError(f"prior.path: {error}") from None
    nothing = torch.zeros(1, obs_dim)
    states = TensorDict(observation=nothing, observation_norm=nothing, batch_size=[1])
    try:
        cross_entropy(make_actor(obs_dim, act_dim).get_dist(states.copy()), prior.get_dist(states))
    except (ValueError, NotImplementedError) as error:  # a teacher of bounded actions, say
        raise ValueError(f"prior.path={path}: no student of this recipe can learn from it: {error}") from None
    if cfg.prior.degrade == "structural":
        last = obs_dim - 1
        _require(0 <= cfg.prior.feature <= last, "prior.feature", cfg.prior.feature, f"a number from 0 to {last}")
