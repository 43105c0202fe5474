"""Every method with every kind of action, collector and device at hand: finite losses, the teacher untouched."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from objectives_cases import same_tensors, total
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded, Categorical, Composite
from torchrl.envs import EnvBase, StepCounter, TransformedEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorBonus, PriorLogProb, PriorWeight
from torchrl_priors.methods import METHODS

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
FRAMES = 32


class Chase(EnvBase):
    """Paid for an action near the first observed number (its sign, if actions are discrete); may end at any step."""

    def __init__(self, discrete: bool) -> None:
        super().__init__(batch_size=[])
        self.discrete = discrete
        self.observation_spec = Composite(observation=Bounded(-1.0, 1.0, shape=(3,)))
        self.action_spec = Categorical(2, shape=()) if discrete else Bounded(-2.0, 2.0, shape=(1,))
        self.reward_spec = Bounded(-9.0, 1.0, shape=(1,))
        self._set_seed(0)

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
        return TensorDict(observation=2 * torch.rand(3, generator=self.rng) - 1)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        first, action = tensordict["observation"][0], tensordict["action"].float().reshape(())
        reward = (action == (first > 0)).float() if self.discrete else 1 - (action - first).square().clamp(max=9)
        end = torch.rand(1, generator=self.rng) < 0.2
        return TensorDict(
            observation=2 * torch.rand(3, generator=self.rng) - 1,
            reward=reward.reshape(1),
            terminated=end,
            done=end.clone(),
        )

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(seed or 0)


def make_env(discrete: bool) -> TransformedEnv:
    return TransformedEnv(Chase(discrete), StepCounter(max_steps=6))


def make_discrete_env() -> TransformedEnv:
    return make_env(True)


def make_continuous_env() -> TransformedEnv:
    return make_env(False)


def make_actor(discrete: bool) -> ProbabilisticActor:
    if discrete:
        net, keys, distribution = nn.Linear(3, 2), ["logits"], torch.distributions.Categorical
    else:
        net = nn.Sequential(nn.Linear(3, 1), AddStateIndependentNormalScale(1))
        keys, distribution = ["loc", "scale"], IndependentNormal
    module = TensorDictModule(net, in_keys=["observation"], out_keys=keys)
    return ProbabilisticActor(module, in_keys=keys, distribution_class=distribution, return_log_prob=True)


def train(method: str, discrete: bool, device: str, collect: Any) -> None:
    """Two rollouts and two updates each, by the three stages as the README has them."""
    torch.manual_seed(0)
    actor, prior = make_actor(discrete).to(device), ActionPrior(make_actor(discrete)).to(device)
    critic, raw_critic = (ValueOperator(nn.Linear(3, 1), in_keys=["observation"]).to(device) for _ in range(2))
    weight = PriorWeight(nn.Linear(3, 1)).to(device) if METHODS[method].adaptive else None
    loss = ClipPPOPriorLoss(actor, critic, AE2RLoss(actor, prior, weight, raw_critic, method=method))
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    gae.set_keys(reward=loss.tensor_keys.reward)
    teacher, before = copy.deepcopy(prior.state_dict()), copy.deepcopy(dict(loss.named_parameters()))
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    rollouts: Iterable[TensorDictBase] = collect(actor, PriorLogProb(prior, actor))
    count = 0
    for rollout in rollouts:
        count += 1
        batch = gae(PriorBonus.from_method(method, weight)(rollout.to(device))).reshape(-1)
        assert batch.numel() == FRAMES
        for _ in range(2):
            losses = loss(batch)
            assert all(value.isfinite().all() for value in losses.values())
            optimizer.zero_grad()
            total(losses).backward()
            optimizer.step()
    assert count == 2
    assert same_tensors(teacher, prior.state_dict())
    learned = {name.split(".")[0] for name, p in loss.named_parameters() if not torch.equal(p, before[name])}
    assert {"actor_network_params", "critic_network_params"} <= learned
    assert all(p.isfinite().all() for p in loss.parameters())


@pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("discrete", [True, False], ids=["discrete", "continuous"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_in_torchrls_collector(method: str, discrete: bool, device: str) -> None:
    def collect(actor: ProbabilisticActor, postproc: PriorLogProb) -> Collector:
        return Collector(
            make_env(discrete),
            actor,
            frames_per_batch=FRAMES,
            total_frames=2 * FRAMES,
            postproc=postproc,
            env_device="cpu",
            policy_device=device,
            storing_device=device,
        )

    train(method, discrete, device, collect)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_in_the_vector_collector(method: str, device: str) -> None:
    """Continuous actions only, which is what it collects."""
    pytest.importorskip("gymnasium")
    from torchrl_priors.collectors import VectorCollector, make_vector_env

    def collect(actor: ProbabilisticActor, postproc: PriorLogProb) -> VectorCollector:
        env = make_vector_env("Pendulum-v1", 2)
        return VectorCollector(
            env, actor, frames_per_batch=FRAMES, total_frames=2 * FRAMES, postproc=postproc, device=device, seed=0
        )

    train(method, False, device, collect)


@pytest.fixture(scope="module", params=["discrete", "continuous"])
def from_processes(request: pytest.FixtureRequest) -> tuple[bool, list[TensorDictBase]]:
    """Starting a process takes seconds, so that the methods share what one collected."""
    discrete = request.param == "discrete"
    torch.manual_seed(0)
    collector = MultiSyncCollector(
        [make_discrete_env if discrete else make_continuous_env],
        make_actor(discrete),
        frames_per_batch=FRAMES,
        total_frames=2 * FRAMES,
    )
    try:
        return discrete, [batch.clone() for batch in collector]
    finally:
        collector.shutdown()


@pytest.mark.parametrize("method", METHODS)
def test_in_a_collector_of_processes(method: str, from_processes: tuple[bool, list[TensorDictBase]]) -> None:
    discrete, batches = from_processes
    train(method, discrete, "cpu", lambda actor, postproc: [postproc(batch.clone()) for batch in batches])
