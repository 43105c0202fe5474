"""Students learn from each kind of teacher."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from multi_teacher_cases import RIGHT, linear, train
from objectives_cases import same_tensors
from sb3_cases import A2C, OFF_POLICY, PPO, SAC, TD3, Noise
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from test_objectives_training import Signs, accuracy, make_actor
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal

from torchrl_priors import (
    AffordancePrior,
    BoltzmannPrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    Prior,
    UniformPrior,
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
    def test_each_kind_of_teacher_teaches_discrete_actions(self, name: str, tmp_path: Any) -> None:
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
