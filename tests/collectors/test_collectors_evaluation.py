"""Evaluation beside training."""

from __future__ import annotations

from typing import Any

import pytest
import torch

pytest.importorskip("gymnasium")

from collectors_cases import deterministic, gaussian, same, scripts, squashed

from torchrl_priors.collectors import RunningNorm, VectorCollector, evaluate, make_vector_env


def test_short_episodes_are_not_favoured() -> None:
    # taking the first 6 episodes to end would take five of length 1
    result = evaluate(scripts((1,), (9,)), gaussian(3, 2), episodes=6, seed=0)
    assert result.lengths.tolist() == [1, 9, 1, 9, 1, 9]
    assert result.returns.tolist() == [1, 45, 1, 45, 1, 45]


@pytest.mark.parametrize("episodes", [1, 2, 3, 4, 7])
def test_any_number_of_episodes_is_evaluated(episodes: int) -> None:
    result = evaluate(scripts((2, 5), (3,), (4,)), gaussian(3, 2), episodes=episodes)
    assert result.lengths.tolist() == [2, 3, 4, 5, 3, 4, 2][:episodes]
    assert result.returns.dtype == torch.float64


@pytest.mark.parametrize("terminates", [True, False])
def test_truncated_episodes_count_as_terminated_ones(terminates: bool) -> None:
    result = evaluate(scripts((2,), (3,), terminates=terminates), gaussian(3, 2), episodes=4)
    assert result.lengths.tolist() == [2, 3, 2, 3]


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("policy", [gaussian, squashed])
def test_a_seed_is_all_that_returns_depend_on(policy: Any, deterministic: bool) -> None:
    env, actor = make_vector_env("Pendulum-v1", 2), policy(3, 1)
    first = evaluate(env, actor, episodes=3, seed=1, deterministic=deterministic)
    torch.rand(5)
    again = evaluate(make_vector_env("Pendulum-v1", 2), actor, episodes=3, seed=1, deterministic=deterministic)
    used = evaluate(env, actor, episodes=3, seed=1, deterministic=deterministic)
    other = evaluate(env, actor, episodes=3, seed=2, deterministic=deterministic)
    assert torch.equal(first.returns, again.returns)
    assert torch.equal(first.returns, used.returns)
    assert not torch.equal(first.returns, other.returns)


@pytest.mark.parametrize("policy", [gaussian, squashed])
def test_the_deterministic_policy_takes_its_mode(policy: Any) -> None:
    actor = policy(3, 2)
    env = scripts((4,))
    evaluate(env, actor, episodes=1, deterministic=True)
    observations = torch.tensor([[0.0, 0.0, time] for time in range(4)])
    with torch.no_grad():
        loc, _ = actor.module[0].module(observations)
    expected = (loc.tanh() if policy is squashed else loc).clamp(-0.5, 0.5)
    torch.testing.assert_close(torch.tensor([action.tolist() for action in env.envs[0].actions]), expected)


def test_the_return_is_that_of_the_collectors_episodes() -> None:
    pytest.importorskip("mujoco")
    env = make_vector_env("Hopper-v5", 2, reset_noise_scale=0.0)
    policy = deterministic(11, 3)
    batch = VectorCollector(env, policy, frames_per_batch=400).rollout()
    done = batch["next", "done"]
    assert done.any()
    result = evaluate(make_vector_env("Hopper-v5", 2, reset_noise_scale=0.0), policy, episodes=2)
    assert result.lengths[0] == batch["next", "step_count"][done][0]
    torch.testing.assert_close(result.returns[0].float(), batch["next", "episode_reward"][done][0])


@pytest.mark.parametrize("policy", [gaussian, squashed])
def test_training_is_the_same_with_and_without_evaluation(policy: Any) -> None:
    actor = policy(3, 1, in_key="observation_norm")

    def train(evaluating: bool) -> Any:
        norm = RunningNorm(3)
        collector = VectorCollector(
            make_vector_env("Pendulum-v1", 2), actor, frames_per_batch=20, normalizer=norm, seed=0
        )
        before, eval_env = torch.random.get_rng_state(), make_vector_env("Pendulum-v1", 2, max_episode_steps=5)
        for _ in range(3):
            batch = collector.rollout()
            if evaluating:
                evaluate(eval_env, actor, episodes=3, normalizer=norm, seed=0)
        assert torch.equal(before, torch.random.get_rng_state())
        return batch

    assert same(train(False), train(True))


def test_the_normaliser_is_read_and_not_updated() -> None:
    norm = RunningNorm(3)
    norm.update(torch.randn(20, 3))
    before = {key: value.clone() for key, value in norm.state_dict().items()}
    actor = gaussian(3, 2, in_key="observation_norm")
    env = scripts((3,))
    evaluate(env, actor, episodes=2, normalizer=norm, deterministic=True)
    assert all(torch.equal(value, before[key]) for key, value in norm.state_dict().items())
    with torch.no_grad():
        loc, _ = actor.module[0].module(norm(torch.tensor([[0.0, 0.0, 0.0]])))
    torch.testing.assert_close(torch.from_numpy(env.envs[0].actions[0]), loc[0].clamp(-0.5, 0.5))


@pytest.mark.parametrize(
    ("policy", "episodes", "message"),
    [
        (gaussian(3, 2), 0, "episodes"),
        (gaussian(3, 2, in_key="observation_norm"), 1, "normalizer"),
    ],
)
def test_what_does_not_fit_is_refused(policy: Any, episodes: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(scripts((1,)), policy, episodes=episodes)
