"""Tiny models of Stable-Baselines3, trained for a moment, with no parameter left as it starts."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torch import nn

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize  # noqa: F401

BOX = spaces.Box(np.array([-2.0, 0.125], np.float32), np.array([2.0, 0.75], np.float32))
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float64)
IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)


class Noise(gym.Env):
    """Random observations; half of the steps end an episode."""

    def __init__(self, observations: spaces.Space = VECTOR, actions: spaces.Space = BOX):
        self.observation_space, self.action_space = observations, actions

    def _observe(self) -> Any:
        if self.observation_space is VECTOR:
            return self.np_random.normal(size=3) * np.array([0.1, 1.0, 30.0]) + 2
        return self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._observe(), float(np.sum(action)), bool(self.np_random.random() < 0.5), False, {}


class Model(NamedTuple):
    algorithm: Any
    kwargs: dict[str, Any]
    policy_kwargs: dict[str, Any]
    observations: spaces.Space = VECTOR
    actions: spaces.Space = BOX
    normalize: bool = False
    told: Any = MappingProxyType({})  # what its prior needs to be told


A2C_STEPS = {"n_steps": 16}
PPO_STEPS = {"n_steps": 16, "batch_size": 8}
OFF_POLICY = {"buffer_size": 64, "learning_starts": 8, "batch_size": 8}
STD, VALUES = {"std": 0.1}, {"temperature": 0.5}
DEEP = {"net_arch": {"pi": [8, 4, 6], "vf": [5]}, "activation_fn": nn.ELU}
MODELS = {
    "ppo": Model(PPO, PPO_STEPS, {}, normalize=True),
    "ppo_discrete": Model(PPO, PPO_STEPS, {}, actions=spaces.Discrete(5)),
    "ppo_image": Model(PPO, PPO_STEPS, {"features_extractor_kwargs": {"features_dim": 16}}, IMAGE, spaces.Discrete(4)),
    "a2c": Model(A2C, A2C_STEPS, DEEP),
    "a2c_linear": Model(A2C, A2C_STEPS, {"net_arch": []}, actions=spaces.Discrete(3), normalize=True),
    "sac": Model(SAC, OFF_POLICY, {"net_arch": [8, 8]}, normalize=True),
    "td3": Model(TD3, OFF_POLICY, {"net_arch": [8, 8], "activation_fn": nn.Tanh}, normalize=True, told=STD),
    "ddpg": Model(DDPG, OFF_POLICY, {"net_arch": [8, 8]}, told=STD),
    "dqn": Model(DQN, OFF_POLICY, {"net_arch": [8, 8]}, actions=spaces.Discrete(4), normalize=True, told=VALUES),
    "dqn_image": Model(
        DQN, OFF_POLICY, {"features_extractor_kwargs": {"features_dim": 16}}, IMAGE, spaces.Discrete(4), told=VALUES
    ),
    "ppo_sde": Model(PPO, {**PPO_STEPS, "use_sde": True}, {}, normalize=True, told=STD),
    "a2c_sde_squashed": Model(A2C, {**A2C_STEPS, "use_sde": True}, {"squash_output": True}, told=STD),
    "sac_sde": Model(SAC, {**OFF_POLICY, "use_sde": True}, {"net_arch": [8, 8]}, normalize=True, told=STD),
    "sac_sde_raw": Model(SAC, {**OFF_POLICY, "use_sde": True}, {"net_arch": [8], "clip_mean": 0.0}, told=STD),
}


class Saved(NamedTuple):
    path: Path
    vecnormalize: Path | None
    model: Any
    env: Any


def save_model(name: str, folder: Path, steps: int = 32) -> Saved:
    """Trains one, moves its parameters, and saves it with its statistics."""
    case = MODELS[name]
    env: Any = DummyVecEnv([lambda: Noise(case.observations, case.actions)])
    if case.normalize:
        env = VecNormalize(env, clip_obs=1.5, epsilon=1e-4)
    policy = "CnnPolicy" if case.observations is IMAGE else "MlpPolicy"
    model = case.algorithm(
        policy, env, device="cpu", seed=0, policy_kwargs=dict(case.policy_kwargs), **case.kwargs
    ).learn(steps)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
        if name == "sac":
            model.actor.log_std.bias[0] += 3  # to be clamped
    model.save(folder / f"{name}.zip")
    path = None
    if case.normalize:
        path = folder / f"{name}.pkl"
        env.save(str(path))
        env.training = False
    return Saved(folder / f"{name}.zip", path, model, env)


def renamed(weights: dict[str, Any], old: str, new: str) -> dict[str, Any]:
    return {name.replace(old, new): value for name, value in weights.items()}


def rewrite(
    source: Path,
    target: Path,
    *,
    weights: Callable[[Any], Any] = lambda w: w,
    data: Callable[[Any], Any] = lambda d: d,
    legacy: bool = False,
) -> Path:
    """A copy of a model with other content."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w") as out:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "policy.pth":
                buffer = io.BytesIO()
                changed = weights(torch.load(io.BytesIO(content), weights_only=True))
                torch.save(changed, buffer, _use_new_zipfile_serialization=not legacy)
                content = buffer.getvalue()
            if name == "data":
                content = json.dumps(data(json.loads(content))).encode()
            out.writestr(name, content)
    return target


NUMBER = 1000


def observations(case: Model, number: int = NUMBER) -> np.ndarray:
    rng = np.random.default_rng(0)
    if case.observations.dtype == np.uint8:
        return rng.integers(0, 256, (number, *case.observations.shape), dtype=np.uint8)
    return rng.normal(size=(number, 3)) * np.array([0.1, 1.0, 30.0]) + 2


def batch_of(raw: np.ndarray) -> TensorDict:
    return TensorDict(observation=torch.as_tensor(raw), batch_size=[len(raw)])
