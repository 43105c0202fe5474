"""What a MuJoCo run learns from: its environment and its teachers, each read once, before there is a folder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gymnasium.vector import VectorEnv
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, TensorSpec

from recipes.common.checks import require
from recipes.mujoco.config import MujocoConfig, Source, check, env_id, sources
from recipes.mujoco.teachers import read_teacher
from torchrl_priors import Prior
from torchrl_priors.collectors import env_state_dict, make_vector_env
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
        actions: how many discrete ones there are, or their dimensions and bounds.
        teachers: by ``prior.path``, as they are there.
    """

    env_id: str
    kwargs: dict[str, object]
    obs_dim: int
    actions: TensorSpec
    teachers: dict[str, Prior]

    @property
    def discrete(self) -> bool:
        """Whether an action is one of some."""
        return isinstance(self.actions, Categorical)

    @property
    def act_dim(self) -> int:
        """Dimensions of an action, or how many discrete ones there are."""
        return self.actions.n if self.discrete else self.actions.shape[0]

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
    name, kwargs = env_id(cfg), dict(cfg.env.kwargs)
    obs_dim, actions = _spaces(name, kwargs)
    task = Task(name, kwargs, obs_dim, actions, {})
    for source in sources(cfg) if cfg.method != "none" else []:
        task.teachers[source.text] = _read(cfg, source, task)
    return task


def _spaces(env_id: str, kwargs: dict[str, object]) -> tuple[int, TensorSpec]:
    """Features of an observation, and the actions, of an environment that is built to see them."""
    try:
        env = make_vector_env(env_id, 1, **kwargs)
        check_vector_env(env)
        observations, actions = env.single_observation_space, env.single_action_space
        for space in (observations, actions):
            if type(space).__name__ == "Box" and (len(space.shape) != 1 or not space.shape[0]):
                raise TypeError(f"Observations and actions must have one dimension, such as (8,), got {space.shape}")
        env.reset(seed=0)
        env_state_dict(env)  # what can't be saved is found out now
        env.close()
        if type(actions).__name__ == "Discrete":
            return observations.shape[0], Categorical(int(actions.n))
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (actions.low, actions.high))
        return observations.shape[0], Bounded(low, high, dtype=torch.float32)
    except Exception as error:  # Gymnasium's own, or whatever its environments raise
        if isinstance(error, ImportError) and ":" not in env_id:  # MuJoCo is missing; a:b is environment b of module a
            raise
        given = "".join(f", {key}={value}" for key, value in kwargs.items())
        raise ValueError(f"env={env_id}{given}: cannot be used ({type(error).__name__}: {error}).") from None


def _read(cfg: MujocoConfig, source: Source, task: Task) -> Prior:
    """A teacher that the student can learn from."""
    prior = read_teacher(cfg, source, task.env_id, task.obs_dim, task.actions)
    nothing = torch.zeros(1, task.obs_dim)
    states = TensorDict(observation=nothing, observation_norm=nothing, batch_size=[1])
    student = make_actor(task.obs_dim, task.act_dim, discrete=task.discrete)
    try:
        cross_entropy(student.get_dist(states.copy()), prior.get_dist(states))
    except (ValueError, NotImplementedError) as error:  # a teacher of bounded actions, say
        raise ValueError(f"prior.path={source}: no student of this recipe can learn from it: {error}") from None
    if cfg.prior.degrade == "structural":
        feature, last = cfg.prior.feature, task.obs_dim - 1
        require(0 <= feature <= last, "prior.feature", feature, f"a number from 0 to {last}")
    return prior
