"""What a MuJoCo run may be configured with: names and types here, defaults in ``conf/mujoco.yaml`` and ``conf/env``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

import recipes.common.sweeps  # noqa: F401  registers the launcher that conf/mujoco.yaml names
from recipes.common.checks import (
    at_home,
    at_least_0,
    check_keys,
    finite,
    one_of,
    positive,
    require,
    require_compiler,
    share,
)
from recipes.common.loggers import LOGGERS, require_logger
from recipes.common.schedules import ScheduleConfig, check_schedule
from torchrl_priors.methods import MethodSpec, get_method

__all__ = ["ALONE", "MujocoConfig", "Source", "check", "env_id", "method_of", "sources"]

ALONE = "alone"
"""The student of a trial that has no teacher."""


@dataclass
class Env:
    """The task, and what is tuned to it."""

    id: str = MISSING
    version: str | None = MISSING
    num_envs: int = positive()
    frames_per_batch: int = positive()
    minibatch_size: int = positive()
    total_frames: int = MISSING
    degrade_feature: int = MISSING
    degrade_threshold: float = MISSING
    kwargs: dict[str, Any] = field(default_factory=dict)


@dataclass
class Prior:
    """The teacher."""

    path: Any = MISSING
    vecnormalize: str | None = MISSING
    outputs: list[str] | None = MISSING
    std: float | None = positive()
    temperature: float | None = positive()
    epsilon: float = share()
    trust_code: bool = MISSING
    degrade: str = one_of("none", "structural", "random", "reversed")
    feature: int = MISSING
    threshold: float = finite()
    prob: float = share()


@dataclass
class Weight:
    """The prior weight."""

    lr_coeff: float = at_least_0()
    init_bias: float = finite()
    trained: str = one_of("minibatch", "rollout", "oracle")
    epochs: int = positive()


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

    methods: str = one_of("trial", "all", "none")
    window: int = positive()
    fall: float = positive()


@dataclass
class PPO:
    """The base algorithm."""

    epochs: int = positive()
    clip_epsilon: float = positive()
    lr: float = positive()
    adam_eps: float = positive()
    gamma: float = share()
    gae_lambda: float = share()
    entropy_coeff: float = at_least_0()
    max_grad_norm: float = positive()
    hidden: list[int] = MISSING


@dataclass
class Evaluation:
    """When and how the frozen policy is evaluated."""

    interval: int = positive()
    episodes: int = positive()


@dataclass
class Checkpoints:
    """What an interruption costs."""

    interval: int = positive()
    keep: int = positive()


@dataclass
class MujocoConfig:
    """The whole configuration of ``python -m recipes.mujoco``."""

    env: Env = field(default_factory=Env)
    method: str = MISSING
    seed: int = at_least_0(below=2**32)
    total_frames: int = positive()
    prior: Prior = field(default_factory=Prior)
    weight: Weight = field(default_factory=Weight)
    trial: Trial = field(default_factory=Trial)
    let_go: LetGo = field(default_factory=LetGo)
    cross_entropy: str | None = one_of("student", "teacher")
    td_error: str = one_of("original", "shaped")
    bonus_coeff: float = at_least_0()
    aux_coeff: float | None = at_least_0()
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    ppo: PPO = field(default_factory=PPO)
    evaluation: Evaluation = field(default_factory=Evaluation)
    checkpoint: Checkpoints = field(default_factory=Checkpoints)
    compile: bool = MISSING
    resume: bool = MISSING
    logger: str = one_of(*LOGGERS)
    label: str | None = MISSING
    out: str | None = MISSING


ConfigStore.instance().store(group="schema", name="mujoco", node=MujocoConfig, package="_global_")
# the method where none is given
OmegaConf.register_new_resolver("method_for", lambda path: "none" if path is None else "trial", replace=True)


def env_id(cfg: MujocoConfig) -> str:
    """The environment, as Gymnasium knows it."""
    return cfg.env.id if cfg.env.version is None else f"{cfg.env.id}-{cfg.env.version}"


@dataclass(frozen=True)
class Source:
    """Where a teacher comes from: a file, or code of the user's, ``module:function``."""

    text: str

    def __str__(self) -> str:
        """As it was given."""
        return self.text

    @property
    def path(self) -> Path:
        """Of its file."""
        return at_home("prior.path", self.text)

    @property
    def kind(self) -> str:
        """``file`` (of this library), ``sb3``, ``torchscript`` or ``code``."""
        if re.fullmatch(r"[^\W\d][\w.]*:[^\W\d][\w.]*", self.text):
            return "code"
        return {".zip": "sb3", ".pt": "torchscript"}.get(self.path.suffix, "file")

    @property
    def name(self) -> str:
        """What its student is called."""
        return self.text if self.kind == "code" else self.path.stem

    @property
    def file_name(self) -> str:
        """The same with the file's ending."""
        return self.text if self.kind == "code" else self.path.name


def sources(cfg: MujocoConfig) -> list[Source]:
    """The teachers, by where they come from."""
    path = cfg.prior.path
    several = path if isinstance(path, Sequence) and not isinstance(path, str) else [path]
    return [] if path is None else [Source(str(one)) for one in several]


def method_of(cfg: MujocoConfig) -> MethodSpec:
    """What is done with the teacher: the settings of the method, or of that which a trial tries.

    Raises:
        ValueError: there is no such method.
    """
    spec = get_method(cfg.trial.method if cfg.method == "trial" else cfg.method)
    return spec if cfg.cross_entropy is None else replace(spec, cross_entropy=cfg.cross_entropy)  # type: ignore[arg-type]


def check(cfg: MujocoConfig) -> None:
    """Refuse what would fail or mean nothing later.

    Raises:
        ValueError: names the key, its value and what was expected.
        ImportError: names the extra that is needed.
    """
    check_keys(cfg)
    method_of(cfg)  # that there is such a method
    files = sources(cfg)
    if cfg.method == "trial":
        _check_arms(cfg, files)
    elif cfg.method != "none":
        expected = "the file of a teacher" if not files else "one teacher; method=trial takes several"
        require(len(files) == 1, "prior.path", cfg.prior.path, f"{expected}, as method={cfg.method} has one")
    _check_reading(cfg, [file.kind for file in files])
    if cfg.method == "trial" or cfg.let_go.methods == "all":
        _check_trial(cfg)
    check_schedule(cfg.schedule)
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


def _check_reading(cfg: MujocoConfig, kinds: Sequence[str]) -> None:
    prior, outputs = cfg.prior, list(cfg.prior.outputs or [])
    expected = "null, or the file of VecNormalize.save beside prior.path=<one .zip of Stable-Baselines3>"
    require(prior.vecnormalize is None or kinds.count("sb3") == 1, "prior.vecnormalize", prior.vecnormalize, expected)
    if "torchscript" in kinds:
        known = [["loc", "scale"], ["logits"], ["action"]]
        expected = "[loc,scale], [logits] or [action], what the teacher of prior.path=<a .pt of TorchScript> gives"
        require(outputs in known, "prior.outputs", prior.outputs, expected)
    else:
        require(not outputs, "prior.outputs", prior.outputs, "null, but for prior.path=<a .pt of TorchScript>")
    require(prior.epsilon > 0, "prior.epsilon", prior.epsilon, "a probability above 0")


def _check_arms(cfg: MujocoConfig, files: Sequence[Source]) -> None:
    arms, method = len(files) + 1, cfg.trial.method
    require(bool(files), "prior.path", cfg.prior.path, "the files of one or more teachers, as method=trial tries them")
    names = [file.name for file in files]
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
    window, expected = cfg.let_go.window, f"at least one rollout of {batch}"
    require(cfg.let_go.methods == "none" or window >= batch, "let_go.window", window, expected)
    require(0 < trial.alpha < 1, "trial.alpha", trial.alpha, "a number between 0 and 1")
    require(0 < trial.recent <= 1, "trial.recent", trial.recent, "a share above 0 and up to 1")
