"""Environments whose every number is known, and policies, for the tests of the collectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_priors.collectors import VectorCollector


class Script(gymnasium.Env):
    """Episodes of given lengths; observes (identity, episode, step) and is paid the number of the step."""

    def __init__(self, identity: int, lengths: Sequence[int], terminates: bool = True) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = gymnasium.spaces.Box(-0.5, 0.5, (2,), np.float32)
        self.identity, self.lengths, self.terminates = identity, lengths, terminates
        self.episode, self.time = -1, 0
        self.actions: list[np.ndarray] = []

    def _observation(self) -> np.ndarray:
        return np.array([self.identity, self.episode, self.time], np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        # the vector hands reset options only to those that it resets
        self.episode, self.time = self.episode + 1, 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        assert self.time < self.lengths[self.episode % len(self.lengths)], "a step after the last one"
        self.actions.append(action.copy())
        self.time += 1
        over = self.time == self.lengths[self.episode % len(self.lengths)]
        return self._observation(), float(self.time), over and self.terminates, over and not self.terminates, {}


def scripts(*lengths: Sequence[int], terminates: bool = True, **kwargs: Any) -> SyncVectorEnv:
    """A vector of scripted environments, one for each sequence of lengths."""
    kwargs.setdefault("autoreset_mode", AutoresetMode.DISABLED)
    return SyncVectorEnv(
        [lambda i=i, each=each: Script(i, each, terminates) for i, each in enumerate(lengths)], **kwargs
    )


def gaussian(
    observations: int,
    actions: int,
    in_key: str = "observation",
    out_keys: Sequence[str] = ("loc", "scale"),
    **kwargs: Any,
) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(observations, 16), nn.Tanh(), nn.Linear(16, actions))
    net.append(AddStateIndependentNormalScale(actions))
    kwargs.setdefault("distribution_class", IndependentNormal)
    kwargs.setdefault("return_log_prob", True)
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=[in_key], out_keys=list(out_keys)), in_keys=list(out_keys), **kwargs
    )


def squashed(observations: int, actions: int, in_key: str = "observation") -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(observations, 2 * actions), NormalParamExtractor())
    nn.init.normal_(net[0].weight, std=1e-3)  # far from saturation, whatever it observes
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=[in_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def deterministic(observations: int, actions: int) -> TensorDictModule:
    net = nn.Sequential(nn.Linear(observations, actions), nn.Tanh())
    nn.init.normal_(net[0].weight)
    return TensorDictModule(net, in_keys=["observation"], out_keys=["action"])


def same(first: Any, second: Any) -> bool:
    """Whether two tensordicts have the same keys and, to the bit, the same values."""
    keys = set(first.keys(True, True))
    return keys == set(second.keys(True, True)) and all(torch.equal(first[key], second[key]) for key in keys)


LENGTHS = [(2, 3), (4,), (5, 1)]


def collector(policy: Any = None, *, frames: int = 24, **kwargs: Any) -> VectorCollector:
    kwargs.setdefault("seed", 0)
    env = kwargs.pop("env", None) or scripts(*LENGTHS)
    return VectorCollector(env, policy or gaussian(3, 2), frames_per_batch=frames, **kwargs)
