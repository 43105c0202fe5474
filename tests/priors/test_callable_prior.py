"""Claims about priors made of functions."""

from __future__ import annotations

import threading
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from teacher_cases import ACTIONS, observations
from tensordict import TensorDict
from torch import distributions as d
from torchrl.envs import GymEnv
from torchrl.modules import OneHotCategorical

from torchrl_priors import CallablePrior, MixturePrior


class TestCallablePrior:
    def test_a_bot_that_changes_its_observations_leaves_the_batch_alone(self) -> None:
        def bot(observation: np.ndarray) -> int:
            observation *= 0
            return 1

        batch = observations(6)
        before = batch["observation"].clone()
        CallablePrior(bot, num_actions=ACTIONS, epsilon=0.1).get_dist(batch)
        assert torch.equal(batch["observation"], before)

    def test_a_method_of_what_cannot_be_copied(self) -> None:
        class Bot:
            def __init__(self) -> None:
                self.handle, self.gain = threading.Lock(), 2.0

            def act(self, observation: np.ndarray) -> np.ndarray:
                with self.handle:
                    return self.gain * observation

        prior = CallablePrior(Bot().act, std=1.0)
        batch = observations(5)
        for twin in (prior, deepcopy(prior), MixturePrior([prior, prior])):
            torch.testing.assert_close(twin.get_dist(batch).mean, 2 * batch["observation"])

    def test_the_action_of_a_controller_that_gives_a_pair_is_taken(self) -> None:
        class Model:
            """As of Stable-Baselines3: what it predicts is sampled by default, and comes with a state."""

            state: Any = None

            def predict(
                self, observation: np.ndarray, state: Any = None, deterministic: bool = False
            ) -> tuple[np.ndarray, Any]:
                noise = 0.0 if deterministic else 100.0
                return observation[..., :2] + noise, self.state

        model, batch = Model(), observations(5)
        for batched in (False, True):
            prior = CallablePrior(model.predict, std=1.0, batched=batched)
            torch.testing.assert_close(prior.get_dist(batch).mean, batch["observation"][:, :2])
        model.state = (np.zeros(3), np.zeros(3))
        with pytest.raises(TypeError, match="it has a memory"):
            prior.get_dist(batch)

    def test_two_actions_are_not_taken_for_a_pair(self) -> None:
        batch = observations(2)
        for prior in (
            CallablePrior(lambda x: (x[0], x[1]), std=1.0),
            CallablePrior(lambda x: tuple(map(tuple, x[:, :2])), std=1.0, batched=True),
        ):
            torch.testing.assert_close(prior.get_dist(batch).mean, batch["observation"][:, :2])

    def test_a_controller_plays_in_an_environment_without_a_batch(self) -> None:
        env = GymEnv("Pendulum-v1")
        prior = CallablePrior(lambda x: -2.0 * x[1:2], std=0.1)
        rollout = env.rollout(5, prior.policy())
        torch.testing.assert_close(rollout["action"], -2.0 * rollout["observation"][:, 1:2])

    def test_one_by_one_and_batched_agree(self) -> None:
        batch = observations(2, 3)
        one = CallablePrior(lambda x: np.tanh(x[:2]), std=[0.1, 0.2])
        many = CallablePrior(lambda x: np.tanh(x[:, :2]), std=[0.1, 0.2], batched=True)
        expected = d.Normal(batch["observation"][..., :2].tanh(), torch.tensor([0.1, 0.2]))
        action = torch.randn(2, 3, 2)
        batch["action"] = action
        for prior in (one, many):
            torch.testing.assert_close(prior.log_prob(batch), expected.log_prob(action).sum(-1))

    @pytest.mark.parametrize("distribution_class", [d.Categorical, OneHotCategorical])
    def test_no_discrete_action_is_impossible(self, distribution_class: Any) -> None:
        prior = CallablePrior(
            lambda x: int(x[0] > 0), num_actions=4, epsilon=0.2, distribution_class=distribution_class
        )
        probs = prior.get_dist(TensorDict(observation=torch.tensor([[1.0], [-1.0]]), batch_size=[2])).probs
        torch.testing.assert_close(probs, torch.tensor([[0.05, 0.85, 0.05, 0.05], [0.85, 0.05, 0.05, 0.05]]))

    def test_a_controller_reads_several_and_nested_keys(self) -> None:
        prior = CallablePrior(lambda a, b: a + b, std=1.0, in_keys=["a", ("deep", "b")])
        batch = TensorDict(a=torch.ones(2, 1), deep=TensorDict(b=2 * torch.ones(2, 1), batch_size=[2]), batch_size=[2])
        assert (prior.get_dist(batch).mean == 3).all()

    @pytest.mark.parametrize(
        ("policy", "kwargs", "match"),
        [
            (lambda x: 5, {"num_actions": 4}, r"actions in \[5, 5\], and num_actions is 4"),
            (lambda x: 0.5, {"num_actions": 4}, "Expected an integer"),
            (lambda x: np.array([np.nan]), {"std": 1.0}, "not finite"),
            (lambda x: 1.0, {"std": 1.0}, r"shape \[act_dim\]"),
            (lambda x: x[:2], {"std": [1.0, 1.0, 1.0]}, r"got \(2,\) and \(3,\)"),
            (lambda x: x[0], {"std": 1.0, "batched": True}, r"shape \(3,\) for 2 observations"),
        ],
    )
    def test_wrong_actions_are_refused(self, policy: Any, kwargs: dict[str, Any], match: str) -> None:
        with pytest.raises(ValueError, match=match):
            CallablePrior(policy, **kwargs).get_dist(observations(2))

    def test_a_controller_without_a_valid_spread_is_refused(self) -> None:
        for kwargs, match in (
            ({}, "Pass std"),
            ({"std": 1.0, "num_actions": 3}, "Pass std"),
            ({"std": -1.0}, "positive"),
            ({"num_actions": 0}, "at least 1"),
            ({"num_actions": 2, "epsilon": 0.0}, "epsilon"),
        ):
            with pytest.raises(ValueError, match=match):
                CallablePrior(lambda x: x, **kwargs)  # type: ignore[arg-type]
