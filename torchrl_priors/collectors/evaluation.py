"""Returns of a policy in a vector of Gymnasium environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_priors.collectors.policy_step import policy_step
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.collectors.vector_env import action_limits, check_vector_env, spread_seed

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv


class Evaluation(NamedTuple):
    """What :func:`evaluate` returns."""

    returns: Tensor
    """Undiscounted returns, float64, ``[episodes]``."""
    lengths: Tensor
    """Steps, int64, ``[episodes]``."""


def evaluate(
    env: VectorEnv,
    policy: TensorDictModuleBase,
    *,
    episodes: int,
    normalizer: RunningNorm | None = None,
    seed: int | None = None,
    deterministic: bool = False,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    normalized_key: NestedKey = "observation_norm",
    device: torch.device | str = "cpu",
) -> Evaluation:
    """Undiscounted returns of the first episodes of each environment.

    Each environment plays a number of episodes that is fixed beforehand (episode ``i`` belongs to environment
    ``i % num_envs``), so that short episodes are not favoured, as they are where the first to end are taken. Nothing is
    left behind but the environments' last states: statistics are read only, and the random numbers are its own, so that
    a training run is the same whether or when it is evaluated.

    Args:
        env (VectorEnv): see :class:`VectorCollector`; not that of a collector, whose episodes would be cut.
        policy (TensorDictModuleBase): see :class:`VectorCollector`.

    Keyword Args:
        episodes (int): number of episodes.
        normalizer (RunningNorm, optional): applied as it is, frozen or not; never updated.
        seed (int, optional): the same gives the same returns. Defaults to None: by the operating system.
        deterministic (bool): the policy's deterministic action instead of a sample. Defaults to False.
        observation_key, action_key, normalized_key, device: see :class:`VectorCollector`.

    Raises:
        ValueError: if ``episodes`` is below 1, or see :class:`VectorCollector`.
        TypeError: see :class:`VectorCollector`.
    """
    check_vector_env(env)
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}.")
    device = torch.device(device)
    step = policy_step(
        policy, action_key, [observation_key] if normalizer is None else [observation_key, normalized_key]
    )
    env_seeds, action_seed = spread_seed(seed, env.num_envs, stream=1)
    generator = torch.Generator(device).manual_seed(action_seed)
    low, high = action_limits(env.single_action_space)

    returns, lengths = np.zeros(episodes), np.zeros(episodes, np.int64)
    current = np.arange(env.num_envs)  # the episode that each environment plays
    obs, _ = env.reset(seed=env_seeds)
    with step.session(generator, deterministic):
        while (playing := current < episodes).any():
            observation = torch.from_numpy(obs.astype(np.float32)).to(device)
            inputs = {observation_key: observation}
            if normalizer is not None:
                inputs[normalized_key] = normalizer(observation.to(normalizer.mean.device)).to(device)
            action = step(inputs)[action_key].cpu().numpy()
            obs, reward, terminated, truncated, _ = env.step(np.clip(action, low, high))
            returns[current[playing]] += reward[playing]
            lengths[current[playing]] += 1
            done = terminated | truncated
            if done.any():
                current[done] += env.num_envs
                obs, _ = env.reset(options={"reset_mask": done})
    return Evaluation(torch.from_numpy(returns), torch.from_numpy(lengths))
