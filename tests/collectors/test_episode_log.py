"""Environments whose state can't be read go on where they were, by what was done in them."""

from __future__ import annotations

import json
from typing import Any

import gymnasium
import pytest
import torch

pytest.importorskip("gymnasium")
from collectors_cases import gaussian, same
from torchrl.modules import ProbabilisticActor

from torchrl_priors.collectors import VectorCollector, env_state_dict, load_env_state_dict, make_vector_env
from torchrl_priors.collectors.episode_log import EpisodeLog
from torchrl_priors.networks import make_actor

SIZES = {"CartPole-v1": (4, 2), "Pendulum-v1": (3, 1), "MountainCarContinuous-v0": (2, 1), "LunarLander-v3": (8, 4)}


def actor(env_id: str) -> ProbabilisticActor:
    observations, actions = SIZES[env_id]
    if env_id in ("CartPole-v1", "LunarLander-v3"):
        return make_actor(observations, actions, in_key="observation", discrete=True)
    return gaussian(observations, actions)


def collector(env_id: str, policy: Any, seed: int = 0) -> VectorCollector:
    return VectorCollector(make_vector_env(env_id, 2), policy, frames_per_batch=60, seed=seed)


@pytest.mark.parametrize("env_id", SIZES)
def test_a_collector_goes_on_bit_by_bit(env_id: str) -> None:
    if env_id == "LunarLander-v3":
        pytest.importorskip("Box2D")
    policy = actor(env_id)
    first = collector(env_id, policy)
    for number in range(4):  # in the first episode of an environment, and in later ones
        state = first.state_dict()
        assert [*json.loads(json.dumps(state["env"]))] == ["episodes"]
        other = collector(env_id, policy, seed=number + 1)
        other.load_state_dict(state)
        ahead = [other.rollout(), other.rollout()]
        assert same(ahead[0], first.rollout())
        assert same(ahead[1], collector_after(first, policy, env_id))


def collector_after(first: VectorCollector, policy: Any, env_id: str) -> Any:
    """The next rollout of a collector, made by another one that goes on from it."""
    other = collector(env_id, policy, seed=9)
    other.load_state_dict(first.state_dict())
    return other.rollout()


class Moody(gymnasium.Env):
    """Has random numbers of its own."""

    observation_space = gymnasium.spaces.Box(-9, 9, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return torch.randn(1).numpy(), {}

    def step(self, action: Any) -> Any:
        return torch.randn(1).numpy(), 0.0, False, False, {}


def test_what_does_not_repeat_itself_is_found_out() -> None:
    env = EpisodeLog(Moody())
    env.reset(seed=0)
    env.step(1)
    with pytest.raises(ValueError, match="Moody: the same actions lead elsewhere"):
        env.play_again(env.episode())


@pytest.mark.parametrize(
    ("other", "message"),
    [(("Pendulum-v1", 3), "2 environments, there are 3"), (("CartPole-v1", 2), "id Pendulum-v1, not CartPole-v1")],
)
def test_the_episode_of_others_is_refused(other: Any, message: str) -> None:
    env, another = make_vector_env("Pendulum-v1", 2), make_vector_env(*other)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        load_env_state_dict(another, env_state_dict(env))


def test_steps_are_those_of_the_environment_itself() -> None:
    plain, logged = gymnasium.make("Pendulum-v1"), EpisodeLog(gymnasium.make("Pendulum-v1"))
    for env in (plain, logged):
        env.reset(seed=3)
        env.action_space.seed(0)
    for _ in range(5):
        action = plain.action_space.sample()
        assert (plain.step(action)[0] == logged.step(action)[0]).all()
