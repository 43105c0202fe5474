"""Claims about learning from several teachers, and from each kind of teacher."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from objectives_cases import same_tensors
from sb3_cases import A2C, OFF_POLICY, PPO, SAC, TD3, Noise
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from test_objectives_training import Signs, accuracy, make_actor
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_priors import (
    AE2RLoss,
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    ClipPPOPriorLoss,
    MixturePrior,
    ModulePrior,
    MultiTeacherLoss,
    Prior,
    PriorShaping,
    PriorWeight,
    UniformPrior,
    prior_transforms,
)
from torchrl_priors.artifacts import load_sb3_prior

pytestmark = pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")


class Follow(Signs):
    """The reward is minus the squared distance of the action to the first of three numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.action_spec = Bounded(-2.0, 2.0, shape=(1,))
        self.reward_spec = Bounded(-20.0, 0.0, shape=(1,))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        error = (tensordict["action"] - tensordict["observation"][:1]).clamp(-4, 4)
        end = torch.rand(1, generator=self.rng) < 0.1
        return TensorDict(observation=self._observe(), reward=-error.square(), terminated=end, done=end.clone())


def normal_actor(distribution_class: Any = IndependentNormal, **kwargs: Any) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(3, 1), AddStateIndependentNormalScale(1))
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        distribution_class=distribution_class,
        distribution_kwargs=kwargs,
        return_log_prob=True,
    )


def train(
    env: Signs, actor: ProbabilisticActor, priors: list[Prior], *, method: str = "ae2r", batches: int = 8
) -> list[PriorWeight]:
    """PPO with an AE2R loss for each teacher; the weights of the teachers."""
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    raw_critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    weights = [PriorWeight(nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 1))) for _ in priors]
    loss_prior = MultiTeacherLoss(
        actor, priors, weights, raw_critic, method=method, gamma=0.9, prior_in_batch=True, num_samples=4
    )
    loss = ClipPPOPriorLoss(actor, critic, loss_prior)
    gae = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    gae.set_keys(reward=loss.tensor_keys.reward)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.03)
    env.set_seed(0)
    collector = Collector(
        env, actor, frames_per_batch=128, total_frames=batches * 128, postproc=prior_transforms(loss, num_samples=1)
    )
    for batch in collector:
        flat = gae(batch).reshape(-1)
        for _ in range(4):
            for index in torch.randperm(128).split(64):
                losses = loss(flat[index])
                objective = sum(value for key, value in losses.items() if key.startswith("loss_"))
                assert objective.isfinite()
                optimizer.zero_grad()
                objective.backward()
                optimizer.step()
    return weights


def sb3_teacher(folder: Any, algorithm: Any, rows: list[list[float]], std: float | None = None) -> Prior:
    """A linear policy with the given weights, by way of Stable-Baselines3's own file."""
    actions = spaces.Discrete(2) if len(rows) == 2 else spaces.Box(-2.0, 2.0, (1,), np.float32)
    off_policy = algorithm in (SAC, TD3)
    model = algorithm(
        "MlpPolicy",
        Noise(actions=actions),
        device="cpu",
        policy_kwargs={"net_arch": [] if not off_policy else {"pi": [], "qf": [4]}},
        **(OFF_POLICY if off_policy else {"n_steps": 64}),
    )
    policy = model.policy
    layer = policy.action_net if not off_policy else policy.actor.mu
    layer = layer[0] if isinstance(layer, nn.Sequential) else layer
    with torch.no_grad():
        layer.weight.copy_(torch.tensor(rows))
        layer.bias.zero_()
        if algorithm is SAC:
            policy.actor.log_std.weight.zero_()
            policy.actor.log_std.bias.fill_(-1.0)
    model.save(folder / "model.zip")
    return load_sb3_prior(folder / "model.zip", std=std)


RIGHT = torch.tensor([[-4.0, 0.0, 0.0], [4.0, 0.0, 0.0]])


def linear(weights: torch.Tensor) -> nn.Linear:
    net = nn.Linear(weights.shape[1], weights.shape[0], bias=False)
    net.weight.data.copy_(weights)
    return net


DISCRETE = {
    "module": lambda _: ModulePrior(linear(RIGHT), "logits"),
    "callable": lambda _: CallablePrior(lambda x: int(x[0] > 0), num_actions=2),
    "affordance": lambda _: AffordancePrior(lambda x: torch.stack([x[..., 0] < 0, x[..., 0] > 0], -1)),
    "mixture": lambda _: MixturePrior([ModulePrior(linear(RIGHT), "logits"), UniformPrior(2)], [0.8, 0.2]),
    "q_network": lambda _: BoltzmannPrior(linear(RIGHT), 1.0),
    "sb3": lambda folder: sb3_teacher(folder, A2C, RIGHT.tolist()),
}
CONTINUOUS = {
    "module": lambda _: ModulePrior(linear(torch.tensor([[1.0, 0.0, 0.0]])), "mean", std=0.3),
    "callable": lambda _: CallablePrior(lambda x: x[:1], std=0.3),
    "mixture": lambda _: MixturePrior(
        [CallablePrior(lambda x: x[:1], std=0.3), ModulePrior(linear(torch.zeros(1, 3)), "mean", std=1.0)], [0.8, 0.2]
    ),
    "sb3_ppo": lambda folder: sb3_teacher(folder, PPO, [[1.0, 0.0, 0.0]]),
    "sb3_sac": lambda folder: sb3_teacher(folder, SAC, [[0.5, 0.0, 0.0]]),
    "sb3_td3": lambda folder: sb3_teacher(folder, TD3, [[0.5, 0.0, 0.0]], std=0.3),
}


class TestEachKindOfTeacher:
    @pytest.mark.parametrize("name", DISCRETE)
    def test_teaches_discrete_actions(self, name: str, tmp_path: Any) -> None:
        prior = DISCRETE[name](tmp_path)
        torch.manual_seed(0)  # the same student for all
        actor = make_actor()
        before = copy.deepcopy(prior.state_dict())
        train(Signs(), actor, [prior], batches=6)
        assert accuracy(actor) > 0.7
        assert same_tensors(before, prior.state_dict())

    @pytest.mark.parametrize("name", CONTINUOUS)
    def test_teaches_continuous_actions(self, name: str, tmp_path: Any) -> None:
        prior = CONTINUOUS[name](tmp_path)
        torch.manual_seed(0)
        # what a squashed teacher says of actions beyond its bounds is of no use
        actor = normal_actor(TanhNormal, low=-2.0, high=2.0) if name == "sb3_sac" else normal_actor()
        before = copy.deepcopy(prior.state_dict())
        x = TensorDict(observation=2 * torch.rand(200, 3) - 1, batch_size=[200])

        def error() -> float:
            with torch.no_grad():
                return (actor.get_dist(x.clone()).deterministic_sample - x["observation"][:, :1]).abs().mean().item()

        start = error()
        train(Follow(), actor, [prior], batches=6)
        assert error() < 0.7 * start
        assert same_tensors(before, prior.state_dict())


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
