"""Vectors of Gymnasium environments, as the collector needs them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_priors.collectors.env_state import is_mujoco

if TYPE_CHECKING:
    from gymnasium import Space
    from gymnasium.vector import SyncVectorEnv, VectorEnv


def make_vector_env(env_id: str, num_envs: int, **kwargs: Any) -> SyncVectorEnv:
    """A :class:`gymnasium.vector.SyncVectorEnv` that does not reset by itself: its last observations are the true ones.

    HalfCheetah, Hopper, Walker2d, Ant and Humanoid (v4, v5) take the same steps, to the bit, faster: observations,
    rewards and ends are computed for all environments at once, and the infos of steps are empty. Environments that are
    none of MuJoCo's keep a log of their episode, by which :func:`env_state_dict` saves their state.

    The models of some environments use features that MuJoCo deprecates. These notices, which MuJoCo would print and
    append to a file in the working directory, are dropped while the environments are built; its other warnings become
    Python warnings. Warnings of the running simulation are left alone.

    Args:
        env_id (str): a registered environment, e.g. ``"HalfCheetah-v5"``.
        num_envs (int): number of environments.
        kwargs: see :func:`gymnasium.make`.

    Raises:
        ImportError: if Gymnasium is not installed.
        ValueError: if ``num_envs`` is below 1.
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
    try:
        import gymnasium

        from torchrl_priors.collectors.episode_log import EpisodeLog
        from torchrl_priors.collectors.mujoco_vector_env import MujocoVectorEnv
    except ImportError as error:
        raise ImportError(
            "make_vector_env needs Gymnasium: install the extra 'mujoco' (pip install 'torchrl-priors[mujoco]')."
        ) from error

    def make() -> gymnasium.Env:
        env = gymnasium.make(env_id, **kwargs)
        return env if is_mujoco(env) else EpisodeLog(env)

    with _quiet_mujoco():
        return MujocoVectorEnv([make] * num_envs)


@contextmanager
def _quiet_mujoco() -> Iterator[None]:
    """Keeps MuJoCo's deprecation notices from the console and from MUJOCO_LOG.TXT."""
    try:
        import mujoco
    except ImportError:
        yield
        return
    messages: list[str] = []
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)
        for message in messages:
            if "deprecated" not in message:
                warnings.warn(f"MuJoCo: {message.strip()}", stacklevel=4)


def check_vector_env(env: VectorEnv) -> None:
    """Refuses an environment that resets by itself, or of observations or actions that are no numbers it can hold."""
    mode = env.metadata.get("autoreset_mode")
    if getattr(mode, "name", mode) != "DISABLED":
        raise ValueError(
            f"The environment's autoreset mode is {mode}, which hides last observations: build it with make_vector_env,"
            " or with autoreset_mode=AutoresetMode.DISABLED."
        )
    observations, actions = env.single_observation_space, env.single_action_space
    if type(observations).__name__ != "Box" or not np.issubdtype(observations.dtype, np.number):
        raise TypeError(f"The environment's observation space must be a Box of numbers, got {observations}.")
    box = type(actions).__name__ == "Box" and np.issubdtype(actions.dtype, np.floating)
    if not box and not (type(actions).__name__ == "Discrete" and actions.start == 0):
        raise TypeError(
            f"The environment's action space must be a Box of real numbers or a Discrete from 0 on, got {actions}."
        )


def action_limits(space: Space) -> tuple[Any, Any]:
    """The least and the greatest action of a space: of a ``Box``, or of a ``Discrete`` from 0 on."""
    return (0, space.n - 1) if type(space).__name__ == "Discrete" else (space.low, space.high)


def spread_seed(seed: int | None, num_envs: int, stream: int) -> tuple[list[int], int]:
    """Independent seeds of the sub-environments and of the actions, from one, or from the operating system.

    Gymnasium's own rule, seed + i, gives sub-environment 1 of seed 0 the numbers of sub-environment 0 of seed 1.
    """
    words = np.random.SeedSequence(seed, spawn_key=(stream,)).generate_state(num_envs + 1)
    *environments, actions = (int(word) for word in words)
    return environments, actions
