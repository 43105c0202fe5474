"""Claims about learning from several teachers."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from multi_teacher_cases import RIGHT, linear, train
from objectives_cases import same_tensors
from tensordict import TensorDict
from test_objectives_training import Signs, accuracy, make_actor
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_priors import (
    AE2RLoss,
    ClipPPOPriorLoss,
    ModulePrior,
    MultiTeacherLoss,
    Prior,
    PriorShaping,
    PriorWeight,
    prior_transforms,
)

pytestmark = pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")


def teacher(right_where: float, namespace: str) -> Prior:
    """Right where the second number has the sign of ``right_where``, wrong elsewhere; always right for 0."""

    def logits(x: torch.Tensor) -> torch.Tensor:
        good = torch.ones_like(x[..., 1]) if right_where == 0 else (right_where * x[..., 1]).sign()
        return 3 * torch.stack([-x[..., 0].sign() * good, x[..., 0].sign() * good], -1)

    class Half(nn.Module):
        forward = staticmethod(logits)

    return ModulePrior(Half(), "logits", namespace=namespace)


class TestSeveralTeachers:
    def test_each_is_trusted_where_it_is_right(self) -> None:
        torch.manual_seed(0)
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = train(Signs(), actor, priors, method="aligned", batches=12)
        x = TensorDict(observation=2 * torch.rand(400, 3) - 1, batch_size=[400])
        in_north = x["observation"][:, 1] > 0
        with torch.no_grad():
            north, south = (weight(x.clone())["prior_weight"].squeeze(-1) for weight in weights)
        assert north[in_north].mean() > 2 * south[in_north].mean()
        assert south[~in_north].mean() > 2 * north[~in_north].mean()
        assert accuracy(actor) > 0.8

    def test_the_good_one_is_preferred(self) -> None:
        torch.manual_seed(0)
        good, actor = teacher(0, "good"), make_actor()
        bad = ModulePrior(linear(-RIGHT), "logits", namespace="bad")
        weights = train(Signs(), actor, [good, bad], method="aligned")
        x = TensorDict(observation=2 * torch.rand(200, 3) - 1, batch_size=[200])
        with torch.no_grad():
            trust = [weight(x.clone())["prior_weight"].mean().item() for weight in weights]
        assert trust[0] > 2 * trust[1]
        assert accuracy(actor) > 0.8

    def batch(self, loss: Any) -> TensorDict:
        env = Signs()
        env.set_seed(0)
        with torch.no_grad():
            data = env.rollout(20, loss.teachers[0].actor_network, break_when_any_done=False)
        return prior_transforms(loss)(data)

    def test_the_bonuses_add_up(self) -> None:
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = [PriorWeight.constant(0.75), PriorWeight.constant(0.5)]
        critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
        data = self.batch(MultiTeacherLoss(actor, priors, weights, critic, bonus_coeff=2.0))
        following = data["next"]
        expected = following["reward"] + 2 * (following["north", "prior_bonus"] + following["south", "prior_bonus"])
        torch.testing.assert_close(following["shaped_reward"], expected)
        torch.testing.assert_close(following["north", "prior_bonus"], 0.75 * following["north", "prior_log_prob"])
        assert (following["north", "prior_bonus"] != following["south", "prior_bonus"]).any()

    def test_each_loss_is_that_of_a_teacher_alone_and_the_critic_is_trained_once(self) -> None:
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = [PriorWeight(nn.Linear(3, 1)), PriorWeight(nn.Linear(3, 1), out_keys=["omega"])]
        critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
        loss = MultiTeacherLoss(actor, priors, weights, critic)
        data = self.batch(loss).reshape(-1)
        losses = loss(data)
        assert set(loss.out_keys) | {"prior_bonus_north", "prior_bonus_south"} == set(losses.keys())
        for name, prior, weight in zip(("north", "south"), priors, weights, strict=True):
            alone = AE2RLoss(actor, prior, weight, critic)
            alone.set_keys(
                prior_log_prob=(name, "prior_log_prob"), prior_bonus=(name, "prior_bonus"),
            )  # fmt: skip
            for key, value in alone(data).items():
                found = losses[key if key in ("loss_prior_critic", "prior_td_error") else f"{key}_{name}"]
                torch.testing.assert_close(found, value)
        parameters = list(loss.parameters())
        assert len(parameters) == 2 + 2 * 2 + 2  # of actor, weights and critic
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        once = AE2RLoss(actor, priors[0], weights[0], critic)
        once.set_keys(prior_log_prob=("north", "prior_log_prob"))
        gradient = torch.autograd.grad(once(data)["loss_prior_critic"], critic.module.weight)[0]
        torch.testing.assert_close(critic.module.weight.grad, gradient)

    @pytest.mark.parametrize("functional", [True, False])
    def test_ppo_around_them_has_their_losses_and_runs_the_student_once(self, functional: bool) -> None:
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = [PriorWeight(nn.Linear(3, 1)) for _ in priors]
        critic, raw_critic = (ValueOperator(nn.Linear(3, 1), in_keys=["observation"]) for _ in range(2))
        prior_loss = MultiTeacherLoss(actor, priors, weights, raw_critic, functional=functional)
        loss = ClipPPOPriorLoss(actor, critic, prior_loss)
        data = GAE(gamma=0.99, lmbda=0.95, value_network=critic)(self.batch(prior_loss)).reshape(-1)
        calls: list[int] = []
        actor.module[0].module.register_forward_hook(lambda *_: calls.append(1))
        losses = loss(data)
        assert len(calls) == 1
        assert set(loss.out_keys) <= set(losses.keys())
        both = {**ClipPPOLoss(actor, critic, functional=functional)(data), **prior_loss(data)}
        for name, value in both.items():
            torch.testing.assert_close(losses[name], value)
        parameters = {p for network in (actor, critic, raw_critic, *weights) for p in network.parameters()}
        assert {p for p in loss.parameters() if p.requires_grad} == parameters
        loss.make_value_estimator(gamma=0.5)
        assert [part.gamma.item() for part in prior_loss.teachers] == [0.5, 0.5]

    @pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # the trainer is experimental
    def test_torchrls_trainer_learns_from_both(self) -> None:
        torch.manual_seed(0)
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = [PriorWeight(nn.Linear(3, 1)) for _ in priors]
        critic, raw_critic = (ValueOperator(nn.Linear(3, 1), in_keys=["observation"]) for _ in range(2))
        loss = ClipPPOPriorLoss(actor, critic, MultiTeacherLoss(actor, priors, weights, raw_critic, gamma=0.9))
        env = Signs()
        env.set_seed(0)
        trainer = PPOTrainer(
            collector=Collector(env, actor, frames_per_batch=64, total_frames=128),
            total_frames=128,
            frame_skip=1,
            optim_steps_per_batch=1,
            num_epochs=2,
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters(), lr=0.03),
            replay_buffer=TensorDictReplayBuffer(
                storage=LazyTensorStorage(64), sampler=SamplerWithoutReplacement(), batch_size=32
            ),
            reward_key=loss.tensor_keys.reward,
            progress_bar=False,
            enable_logging=False,
        )
        PriorShaping().register(trainer)
        before = copy.deepcopy([weight.state_dict() for weight in weights])
        trainer.train()
        assert not any(same_tensors(old, weight.state_dict()) for old, weight in zip(before, weights, strict=True))

    def test_keys_are_renamed_for_all(self) -> None:
        priors, actor = [teacher(1, "north"), teacher(-1, "south")], make_actor()
        weights = [PriorWeight(nn.Linear(3, 1)), PriorWeight(nn.Linear(3, 1))]
        loss = MultiTeacherLoss(actor, priors, weights, ValueOperator(nn.Linear(3, 1), in_keys=["observation"]))
        loss.set_keys(reward="raw")
        assert ("next", "raw") in loss.in_keys
        assert ("next", "reward") not in loss.in_keys
        with pytest.raises(ValueError, match="prior_log_prob for all teachers"):
            loss.set_keys(prior_log_prob="x")

    def test_teachers_that_would_share_entries_are_refused(self) -> None:
        actor, prior = make_actor(), teacher(1, "north")
        weight = PriorWeight(nn.Linear(3, 1))
        with pytest.raises(ValueError, match="namespace of its own"):
            MultiTeacherLoss(actor, [prior, prior], method="kickstart")
        with pytest.raises(ValueError, match="2 teachers needs a prior weight of its own, got 1"):
            MultiTeacherLoss(actor, [prior, teacher(-1, "south")], [weight])
        with pytest.raises(ValueError, match="weight of its own"):
            MultiTeacherLoss(actor, [prior, teacher(-1, "south")], [weight, weight])
