"""What a MuJoCo run learns from: its environment and its teachers, each read once, before there is a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from gymnasium.vector import VectorEnv
from tensordict import TensorDict

from recipes.common.checks import require
from recipes.mujoco.config import MujocoConfig, check, teachers
from torchrl_priors import Prior
from torchrl_priors.artifacts import ArtifactError, load_prior
from torchrl_priors.collectors import make_vector_env
from torchrl_priors.collectors.vector_env import check_vector_env
from torchrl_priors.distributions import cross_entropy
from torchrl_priors.networks import make_actor

__all__ = ["Task", "open_task"]


@dataclass(frozen=True)
class Task:
    """An environment, and who teaches there.

    Attributes:
        env_id: with its version, as Gymnasium knows it.
        obs_dim: features of an observation.
        act_dim: dimensions of an action.
        teachers: by their files, as they are in them.
    """

    env_id: str
    kwargs: dict[str, object]
    obs_dim: int
    act_dim: int
    teachers: dict[str, Prior]

    def make_env(self, number: int) -> VectorEnv:
        """So many environments."""
        return make_vector_env(self.env_id, number, **self.kwargs)


def open_task(cfg: MujocoConfig) -> Task:
    """The task of a configuration, and whether it makes sense.

    Raises:
        ValueError, FileNotFoundError: names the key, its value and what was expected.
        ImportError: names the extra that is needed.
    """
    check(cfg)
    env_id, kwargs = f"{cfg.env.id}-{cfg.env.version}", dict(cfg.env.kwargs)
    obs_dim, act_dim = _sizes(env_id, kwargs)
    files = teachers(cfg) if cfg.method != "none" else []
    return Task(
        env_id, kwargs, obs_dim, act_dim, {str(file): _read(cfg, file, env_id, obs_dim, act_dim) for file in files}
    )


def _sizes(env_id: str, kwargs: dict[str, object]) -> tuple[int, int]:
    """Features of an observation and dimensions of an action, of an environment that is built to see them."""
    try:
        env = make_vector_env(env_id, 1, **kwargs)
        check_vector_env(env)
        env.close()
        return env.single_observation_space.shape[0], env.single_action_space.shape[0]
    except Exception as error:  # Gymnasium's own, or whatever its environments raise
        if isinstance(error, ImportError) and ":" not in env_id:  # MuJoCo is missing; a:b is environment b of module a
            raise
        given = "".join(f", {key}={value}" for key, value in kwargs.items())
        raise ValueError(f"env={env_id}{given}: cannot be used ({type(error).__name__}: {error}).") from None


def _read(cfg: MujocoConfig, path: Path, env_id: str, obs_dim: int, act_dim: int) -> Prior:
    """A teacher from its file."""
    if not path.is_file():
        raise FileNotFoundError(
            f"prior.path={path}: {'a folder, expected a file' if path.is_dir() else 'no such file'}."
        )
    try:
        prior: Prior = load_prior(path, env_id=env_id, observation_spec=obs_dim, action_spec=act_dim)
    except ArtifactError as error:
        raise ValueError(f"prior.path: {error}") from None
    nothing = torch.zeros(1, obs_dim)
    states = TensorDict(observation=nothing, observation_norm=nothing, batch_size=[1])
    try:
        cross_entropy(make_actor(obs_dim, act_dim).get_dist(states.copy()), prior.get_dist(states))
    except (ValueError, NotImplementedError) as error:  # a teacher of bounded actions, say
        raise ValueError(f"prior.path={path}: no student of this recipe can learn from it: {error}") from None
    if cfg.prior.degrade == "structural":
        feature = cfg.prior.feature
        require(0 <= feature < obs_dim, "prior.feature", feature, f"a number from 0 to {obs_dim - 1}")
    return prior
