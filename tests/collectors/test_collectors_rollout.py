"""What a collector's rollouts hold."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")

from collectors_cases import LENGTHS, collector, deterministic, gaussian, same, scripts
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Compose, DoubleToFloat
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, PriorLogProb
from torchrl_priors.collectors import RunningNorm, VectorCollector, make_vector_env
from torchrl_priors.networks import make_actor, make_critic


class TestEpisodes:
    """Scripted environments: every observation says whose it is, and when."""

    def test_the_next_observation_is_the_true_last_one_and_the_following_root_the_reset_one(self) -> None:
        batch = collector().rollout()
        # environment 0 has episodes of 2, 3, 2, 3 steps
        episode, time = batch["observation"][0, :, 1], batch["observation"][0, :, 2]
        next_episode, next_time = batch["next", "observation"][0, :, 1], batch["next", "observation"][0, :, 2]
        assert episode.tolist() == next_episode.tolist() == [0, 0, 1, 1, 1, 2, 2, 3]
        assert time.tolist() == [0, 1, 0, 1, 2, 0, 1, 0]
        assert next_time.tolist() == [1, 2, 1, 2, 3, 1, 2, 1]
        assert batch["next", "done"][0, :, 0].tolist() == [False, True, False, False, True, False, True, False]

    @pytest.mark.parametrize("terminates", [True, False])
    def test_terminated_and_truncated_are_told_apart(self, terminates: bool) -> None:
        batch = collector(env=scripts(*LENGTHS, terminates=terminates)).rollout()
        assert batch["next", "done"].any()
        assert torch.equal(batch["next", "done"], batch["next", "terminated" if terminates else "truncated"])
        assert not batch["next", "truncated" if terminates else "terminated"].any()

    def test_episodes_go_on_from_batch_to_batch(self) -> None:
        whole = collector(deterministic(3, 2), frames=24).rollout()
        parts = collector(deterministic(3, 2), frames=6)
        joined = torch.cat([parts.rollout() for _ in range(4)], 1)
        for key in ("observation", ("collector", "traj_ids"), ("next", "episode_reward"), ("next", "step_count")):
            assert torch.equal(whole[key], joined[key])

    def test_each_episode_has_an_id_of_its_own(self) -> None:
        batch = collector().rollout()
        ids = batch["collector", "traj_ids"].float().unsqueeze(-1)
        episodes = torch.cat([batch["observation"][..., :2], ids], -1).reshape(-1, 3).unique(dim=0)
        assert len(episodes) == len(episodes[:, :2].unique(dim=0)) == len(episodes[:, 2].unique())

    def test_episode_reward_and_step_count_are_those_of_the_episode_so_far(self) -> None:
        batch = collector().rollout()
        steps = batch["next", "step_count"]
        assert torch.equal(steps[..., 0], batch["next", "observation"][..., 2].long())
        assert torch.equal(batch["next", "episode_reward"], (steps * (steps + 1) / 2).float())

    def test_the_stored_action_is_the_drawn_one_and_the_sent_one_is_clipped(self) -> None:
        env = scripts(*LENGTHS)
        batch = collector(env=env).rollout()
        assert (batch["action"].abs() > 0.5).any()
        for i, sub in enumerate(env.envs):
            assert torch.equal(torch.from_numpy(np.stack(sub.actions)), batch["action"][i].clamp(-0.5, 0.5))


class TestBatch:
    def test_a_batch_is_named_owned_and_without_gradient(self) -> None:
        collecting = collector(gaussian(3, 2))
        first = collecting.rollout()
        before = first.clone()
        second = collecting.rollout()
        assert first.shape == (3, 8)
        assert first.names == [None, "time"]
        assert first["next"].names == [None, "time"]
        assert same(first, before)
        assert not same(first, second)
        assert not any(value.requires_grad for value in first.values(True, True))
        assert first["next", "reward"].dtype == first["observation"].dtype == torch.float32

    def test_iteration_over_a_collector_ends_at_total_frames(self) -> None:
        collecting = collector(total_frames=72)
        assert [batch.numel() for batch in collecting] == [24, 24, 24]
        assert collecting.frames == 72
        assert not list(collecting)

    def test_postproc_has_the_last_word(self) -> None:
        collecting = collector(postproc=lambda batch: batch.select("action"))
        assert list(collecting.rollout().keys()) == ["action"]

    def test_a_rollout_has_nested_keys_where_they_are_asked_for(self) -> None:
        policy = gaussian(3, 2, in_key=("agent", "norm"), out_keys=[("agent", "loc"), ("agent", "scale")])
        batch = collector(
            policy, observation_key=("agent", "obs"), normalized_key=("agent", "norm"), normalizer=RunningNorm(3)
        ).rollout()
        assert {("agent", "obs"), ("agent", "norm"), ("agent", "loc")} <= set(batch.keys(True))
        assert {("next", "agent", "obs"), ("next", "agent", "norm")} <= set(batch.keys(True))

    @pytest.mark.parametrize("env_id", ["Hopper-v5", "Pendulum-v1"])
    def test_a_rollout_is_that_of_torchrls_collector(self, env_id: str) -> None:
        pytest.importorskip("mujoco")
        # no noise at resets: both collectors meet the same episodes; and episodes that end, by falling or by time
        kwargs = {"reset_noise_scale": 0.0} if env_id == "Hopper-v5" else {"max_episode_steps": 7}
        env = make_vector_env(env_id, 3, **kwargs)
        observations, actions = env.single_observation_space.shape[0], env.single_action_space.shape[0]
        policy = deterministic(observations, actions)
        with torch.no_grad():
            policy.module[0].weight.mul_(0.3)
        ours = VectorCollector(env, policy, frames_per_batch=180, seed=0).rollout()

        reference = make_vector_env(env_id, 3, **kwargs)
        wrapped = TransformedEnv(
            GymWrapper(reference), Compose(DoubleToFloat(), RewardSum(), StepCounter(step_count_key="step_count"))
        )
        theirs = next(
            iter(
                Collector(
                    wrapped, policy, frames_per_batch=180, total_frames=180, auto_register_policy_transforms=False
                )
            )
        )
        assert ours.names == theirs.names
        if env_id == "Pendulum-v1":  # starts anywhere: what can be compared is when episodes end
            keys = [("next", "done"), ("next", "truncated"), ("next", "step_count"), ("collector", "traj_ids")]
        else:
            keys = [key for key in ours.keys(True, True) if key in theirs.keys(True, True)]
            assert set(theirs.keys(True, True)) - set(keys) <= {"episode_reward", "step_count"}
            assert set(keys) == set(ours.keys(True, True))
        assert ours["next", "done"].sum() >= 3
        for key in keys:
            torch.testing.assert_close(ours[key], theirs[key], msg=lambda text, key=key: f"{key}: {text}")

    def test_torchrls_advantages_and_the_priors_log_probs_take_a_batch_as_it_is(self) -> None:
        actor, critic = gaussian(3, 2, in_key="observation_norm"), make_critic(3)
        prior = ActionPrior(gaussian(3, 2, in_key="observation"))
        batch = collector(actor, normalizer=RunningNorm(3), postproc=PriorLogProb(prior, actor)).rollout()
        assert batch["prior_log_prob"].shape == (3, 8, 1)
        assert batch["next", "prior_log_prob"].isfinite().all()
        assert GAE(gamma=0.99, lmbda=0.95, value_network=critic)(batch)["advantage"].isfinite().all()


class TestNormalizer:
    def test_statistics_are_fixed_during_a_rollout_and_take_its_roots_afterwards(self) -> None:
        norm = RunningNorm(3)
        collecting = collector(gaussian(3, 2, in_key="observation_norm"), normalizer=norm)
        reference = RunningNorm(3)
        for _ in range(3):
            fixed = copy.deepcopy(norm)
            batch = collecting.rollout()
            assert torch.equal(batch["observation_norm"], fixed(batch["observation"]))
            assert torch.equal(batch["next", "observation_norm"], fixed(batch["next", "observation"]))
            reference.update(batch["observation"])
            assert torch.equal(norm.mean, reference.mean)
            assert torch.equal(norm.var, reference.var)

    def test_the_policy_saw_what_is_stored(self) -> None:
        actor = gaussian(3, 2, in_key="observation_norm")
        collecting = collector(actor, normalizer=RunningNorm(3, clip=1.0))
        for _ in range(2):
            batch = collecting.rollout()
            with torch.no_grad():
                loc = actor.get_dist(batch.select("observation_norm")).mean
            torch.testing.assert_close(batch["loc"], loc)
        assert batch["observation_norm"].abs().max() == 1

    def test_frozen_statistics_stay(self) -> None:
        norm = RunningNorm(3)
        norm.update(torch.randn(10, 3))
        mean = norm.mean.clone()
        collector(gaussian(3, 2, in_key="observation_norm"), normalizer=norm.freeze()).rollout()
        assert torch.equal(norm.mean, mean)


class TestErrors:
    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"frames": 25}, "frames_per_batch"),
            ({"frames": 0}, "frames_per_batch"),
            ({"total_frames": 30}, "total_frames"),
            ({"policy": gaussian(3, 2, in_key="observation_norm")}, "normalizer"),
            ({"policy": gaussian(3, 2, in_key="pixels")}, "pixels"),
            ({"action_key": "move"}, "move"),
        ],
    )
    def test_what_does_not_fit_is_refused(self, kwargs: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            collector(**kwargs)

    @pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
    def test_an_environment_that_resets_by_itself_is_refused(self, mode: AutoresetMode) -> None:
        with pytest.raises(ValueError, match="make_vector_env"):
            collector(env=scripts(*LENGTHS, autoreset_mode=mode))

    def test_actions_that_are_counted_from_1_are_refused(self) -> None:
        env = make_vector_env("CartPole-v1", 3)
        env.single_action_space = Discrete(2, start=1)
        with pytest.raises(TypeError, match="action space"):
            collector(env=env)


def test_a_discrete_policy_acts_by_indices() -> None:
    policy = make_actor(4, 2, in_key="observation", discrete=True)
    batch = VectorCollector(make_vector_env("CartPole-v1", 3), policy, frames_per_batch=60, seed=0).rollout()
    assert set(batch["action"].unique().tolist()) == {0, 1}
    log_prob = policy.get_dist(batch.copy()).log_prob(batch["action"])
    torch.testing.assert_close(batch["action_log_prob"], log_prob)
