"""The losses with the library's own priors, weights and transforms, in a training loop and in torchrl's trainer."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives_cases import loss_names, make_batch, make_critic, make_ppo_prior, same_tensors, total
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, Composite, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import Compose, EnvBase, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms.ppo import PPOTrainer

from torchrl_priors.degradation import RandomDegradation
from torchrl_priors.methods import METHODS
from torchrl_priors.objectives import AE2RLoss, AVECMixin, ClipPPOPriorLoss, ValueOffset
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.priors import ActionPrior, BoltzmannPrior
from torchrl_priors.transforms import PriorBonus, PriorLogProb


class Signs(EnvBase):
    """The reward is 1 for saying whether the first of three numbers is positive; one step in ten ends the episode."""

    def __init__(self):
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Bounded(-1.0, 1.0, shape=(3,)))
        self.action_spec = Categorical(2, shape=())
        self.reward_spec = Bounded(0.0, 1.0, shape=(1,))

    def _observe(self):
        return 2 * torch.rand(3, generator=self.rng) - 1

    def _reset(self, tensordict):
        return TensorDict(observation=self._observe())

    def _step(self, tensordict):
        right = tensordict["action"] == (tensordict["observation"][0] > 0)
        end = torch.rand(1, generator=self.rng) < 0.1
        return TensorDict(
            observation=self._observe(), reward=right.float().reshape(1), terminated=end, done=end.clone()
        )

    def _set_seed(self, seed):
        self.rng = torch.Generator().manual_seed(0 if seed is None else seed)


def make_actor(weight=None):
    net = nn.Linear(3, 2)
    if weight is not None:
        net.weight.data = torch.tensor([[-weight, 0.0, 0.0], [weight, 0.0, 0.0]])
        net.bias.data.zero_()
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["logits"])
    return ProbabilisticActor(
        module, in_keys=["logits"], distribution_class=torch.distributions.Categorical, return_log_prob=True
    )


class AVECPrior(AVECMixin, ClipPPOPriorLoss):
    pass


def make_all(method="ae2r", loss_class=ClipPPOPriorLoss, prior=None, **kwargs):
    """Networks, the two transforms and the loss, sharing the networks as a user would."""
    actor = make_actor()
    critic = ValueOperator(nn.Sequential(nn.Linear(3, 1), ValueOffset()), in_keys=["observation"])
    weight = PriorWeight(nn.Linear(3, 1)) if METHODS[method].adaptive else None
    prior = ActionPrior(make_actor(weight=4.0)) if prior is None else prior
    options = {"method": method, "gamma": 0.9, **kwargs}
    loss = make_ppo_prior(actor, critic, prior, weight, make_critic(), loss_class, **options)
    postproc = Compose(PriorLogProb(prior, actor), PriorBonus.from_method(method, weight))
    return actor, critic, prior, loss, postproc


def make_env(seed=0):
    env = TransformedEnv(Signs(), StepCounter(max_steps=8))
    env.set_seed(seed)
    return env


def make_optimizer(loss, lr=0.05):
    slow = set(loss.prior_loss.prior_weight_params.parameters()) if loss.prior_loss.spec.adaptive else set()
    fast = [p for p in loss.parameters() if p not in slow and p.requires_grad]
    return torch.optim.Adam([{"params": fast}, {"params": list(slow), "lr": 0.1 * lr}], lr=lr)


def accuracy(actor):
    observation = 2 * torch.rand(1000, 3) - 1
    action = actor.get_dist(TensorDict(observation=observation)).logits.argmax(-1)
    return (action == (observation[:, 0] > 0)).float().mean().item()


@pytest.mark.filterwarnings("ignore:The env passed to Collector:FutureWarning")
@pytest.mark.parametrize("method", METHODS)
def test_a_short_loop_learns_and_leaves_the_teacher(method):
    actor, critic, prior, loss, postproc = make_all(method, AVECPrior if method == "ae2r" else ClipPPOPriorLoss)
    before = copy.deepcopy(prior.state_dict())
    collector = Collector(make_env(), actor, frames_per_batch=64, total_frames=16 * 64, postproc=postproc)
    gae = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    gae.set_keys(reward=loss.tensor_keys.reward)
    optimizer = make_optimizer(loss)
    for batch in collector:
        flat = gae(batch).reshape(-1)
        for _ in range(4):
            for index in torch.randperm(64).split(32):
                losses = loss(flat[index])
                assert all(torch.isfinite(losses[key]) for key in (*loss.prior_loss.out_keys, *loss_names(losses)))
                optimizer.zero_grad()
                total(losses).backward()
                optimizer.step()
        if isinstance(loss, AVECPrior):
            loss.update_value_offset(flat)
    collector.shutdown()
    assert same_tensors(before, prior.state_dict())
    assert accuracy(actor) > 0.8


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # the trainer is experimental, and says so
@pytest.mark.parametrize("method", ["ae2r", "kickstart", "none"])
def test_torchrls_trainer_learns_from_the_teacher(method):
    actor, _, prior, loss, postproc = make_all(method)
    before = copy.deepcopy(prior.state_dict())
    start = accuracy(actor)
    trainer = PPOTrainer(
        collector=Collector(make_env(), actor, frames_per_batch=64, total_frames=256, postproc=postproc),
        total_frames=256,
        frame_skip=1,
        optim_steps_per_batch=1,
        num_epochs=4,
        loss_module=loss,
        optimizer=make_optimizer(loss),
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(64), sampler=SamplerWithoutReplacement(), batch_size=32
        ),
        reward_key=loss.tensor_keys.reward,
        gamma=0.9,
        progress_bar=False,
        enable_logging=False,
    )
    parameters = copy.deepcopy(dict(loss.named_parameters()))
    trainer.train()
    assert same_tensors(before, prior.state_dict())
    changed = {name.split(".")[0] for name, p in loss.named_parameters() if not torch.equal(p, parameters[name])}
    assert {"actor_network_params", "critic_network_params"} <= changed
    assert accuracy(actor) > min(start, 0.6)


@pytest.mark.parametrize("functional", [True, False])
def test_a_learned_weight_is_seen_by_the_bonus(functional):
    """The transform evaluates the very weight that the loss trains."""
    _, _, _, loss, postproc = make_all("ae2r", functional=functional)
    batch = make_batch(batch=(8,))
    batch.names = ["time"]
    before = postproc(batch.copy())["next", "prior_bonus"]
    optimizer = make_optimizer(loss, lr=1.0) if functional else torch.optim.SGD(loss.parameters(), lr=1.0)
    total(loss(postproc(batch.copy()))).backward()
    optimizer.step()
    assert not torch.equal(postproc(batch.copy())["next", "prior_bonus"], before)


def test_the_bonus_of_the_transform_is_what_the_weight_regresses_on():
    """At the weight's own bonus, E_t - B_t(w) is the residual of the loss: two ways to one number."""
    _, _, _, loss, postproc = make_all("ae2r", reduction="none")
    batch = make_batch(batch=(8,))
    batch.names = ["time"]
    batch = postproc(batch)
    losses = loss(batch)
    with torch.no_grad():
        critic = loss.prior_loss.get_stateful_net("critic_network")
        value, following = (critic(td.copy())["state_value"] for td in (batch, batch["next"]))
        error = value - batch["next", "reward"] - 0.9 * (~batch["next", "terminated"]) * following
    expected = (error - batch["next", "prior_bonus"]).square().squeeze(-1)
    torch.testing.assert_close(losses["loss_prior_weight"], expected)


def test_bonus_and_auxiliary_loss_share_a_random_draw():
    good = BoltzmannPrior(nn.Linear(3, 2))
    prior = RandomDegradation(good, 0.5, seed=0)
    _, _, _, loss, postproc = make_all("e2r", prior=prior, reduction="none")
    batch = make_batch(batch=(32,))
    batch.names = ["time"]
    batch = postproc(batch)
    draw = batch["prior", "degraded"].squeeze(-1)
    assert draw.any()
    assert not draw.all()
    first, second = (loss(batch)["loss_prior"] for _ in range(2))
    assert torch.equal(first, second)
    clean = AE2RLoss(loss.actor_network, good, method="e2r", reduction="none")(batch)["loss_prior"]
    bad = AE2RLoss(loss.actor_network, good.adversary(), method="e2r", reduction="none")(batch)["loss_prior"]
    torch.testing.assert_close(first, torch.where(draw, bad, clean))


@pytest.mark.parametrize("weight", [PriorWeight.table(5), PriorWeight.constant(0.25)], ids=["table", "constant"])
def test_a_tabular_prior_and_weight_train_together(weight):
    """Everything looked up by an integer state: the tables of the gridworld in the same loss."""
    logits = nn.Embedding(5, 2)
    actor = ProbabilisticActor(
        TensorDictModule(logits, in_keys=["state"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
    )
    critic = ValueOperator(nn.Embedding(5, 1), in_keys=["state"])
    q = torch.randn(5, 2)
    loss = AE2RLoss(actor, BoltzmannPrior(q), weight, critic, reduction="none")
    data = make_batch().exclude("observation", ("next", "observation"))
    data["state"], data["next", "state"] = torch.randint(5, (2, 6))
    losses = loss(data)
    omega = weight(data.copy())["prior_weight"].squeeze(-1)
    student = logits(data["state"]).log_softmax(-1)
    expected = -omega * (student.exp() * q.log_softmax(-1)[data["state"]]).sum(-1)
    torch.testing.assert_close(losses["loss_prior"], expected)
    total(losses).sum().backward()
    reached = [p.grad is not None and bool(p.grad.any()) for p in weight.parameters()]
    assert reached == ([True] if list(weight.parameters()) else [])


def test_reset_restores_the_scale_of_the_prior_weight():
    _, _, _, loss, _ = make_all("ae2r")
    for p in loss.prior_loss.prior_weight_params.parameters():
        p.data.fill_(3.0)
    loss.reset_parameters_recursive()
    weight, bias = (p for _, p in sorted(loss.prior_loss.prior_weight_params.named_parameters(), reverse=True))
    assert 0 < weight.abs().max() < 0.01
    assert bias.item() == 0.0
