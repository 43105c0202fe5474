"""AE2RLoss against a loop over steps, and its claims about gradients."""

from __future__ import annotations

import math

import pytest
import torch
from objectives_cases import (
    loss_names,
    make_actor,
    make_ae2r,
    make_batch,
    make_constant_weight,
    make_critic,
    make_weight,
    same_tensors,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import ProbabilisticActor

from torchrl_priors.methods import METHODS
from torchrl_priors.objectives import AE2RLoss

ADAPTIVE = [name for name, spec in METHODS.items() if spec.adaptive]


def loop(loss, data, spec, td_error, weight_target, coeff):
    """The losses step by step in plain Python numbers."""
    out = {"loss_prior": [], "loss_prior_weight": [], "loss_prior_critic": []}
    with torch.no_grad():
        for step in data.unbind(0):
            here, there = step["observation"], step["next", "observation"]
            logits, prior_logits = (
                network.get_dist(TensorDict({"observation": here})).logits
                for network in (loss.actor_network, loss.prior)
            )
            entropy = -sum(math.exp(p) * q for p, q in zip(logits.tolist(), prior_logits.tolist(), strict=True))
            w, w_next = (loss.prior_weight.module(x).item() for x in (here, there))
            v, v_next = (loss.critic_network.module(x).item() for x in (here, there))
            alive = 0.0 if step["next", "terminated"].item() else 1.0
            target = step["next", "reward"].item() + 0.9 * alive * v_next
            log_prob, next_log_prob = step["prior_log_prob"].item(), step["next", "prior_log_prob"].item()
            if weight_target == "advantage":
                y, signal, at = target - v, log_prob + entropy, w
            elif spec.bonus == "next":
                y, signal, at = v - target, coeff * alive * next_log_prob, w_next
            else:
                y, signal, at = v - target, coeff * log_prob, w
            if spec.auxiliary:
                pull = entropy
                if spec.cross_entropy == "teacher":
                    pull = -sum(math.exp(q) * p for p, q in zip(logits.tolist(), prior_logits.tolist(), strict=True))
                out["loss_prior"].append(3.0 * (w if spec.adaptive else 1.0) * pull)
            if spec.adaptive:
                out["loss_prior_weight"].append(5.0 * (y - at * signal) ** 2)
                if td_error == "original":
                    out["loss_prior_critic"].append(7.0 * (v - target) ** 2)
    return {key: torch.tensor(value) for key, value in out.items() if value}


@pytest.mark.parametrize("weight_target", ["td", "advantage"])
@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", METHODS)
def test_losses_are_those_of_a_loop_over_steps(method, td_error, weight_target):
    spec = METHODS[method]
    options = {"td_error": td_error, "weight_target": weight_target, "bonus_coeff": 0.5}
    options |= {"aux_coeff": 3.0, "weight_coeff": 5.0, "critic_coeff": 7.0, "gamma": 0.9}
    if spec.adaptive and (
        (weight_target == "td" and spec.bonus == "none")
        or (weight_target == "advantage" and td_error == "shaped" and spec.bonus != "none")
    ):
        with pytest.raises(ValueError, match="weight_target"):
            make_ae2r(method, **options)
        return
    loss = make_ae2r(method, **options, reduction="none", functional=False)
    if not spec.adaptive:
        assert loss.prior_weight is None
        assert loss.critic_network is None
        loss.__dict__.update(prior_weight=make_weight(), critic_network=make_critic())  # for the loop only
    data = make_batch()
    expected = loop(loss, data, spec, td_error, weight_target, coeff=0.5)
    losses = loss(data)
    assert loss_names(losses) == expected.keys()
    for key, value in expected.items():
        torch.testing.assert_close(losses[key], value)


REACHES = {
    "loss_prior": "actor_network_params",
    "loss_prior_weight": "prior_weight_params",
    "loss_prior_critic": "critic_network_params",
}


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("kind", ["categorical", "one_hot", "normal", "tanh_normal"])
@pytest.mark.parametrize("method", ["e2r", *ADAPTIVE, "kickstart"])
def test_each_loss_reaches_its_own_network_only(method, kind, functional):
    loss = make_ae2r(method, kind, functional=functional)
    data = make_batch(kind)
    for key in (key for key in loss.out_keys if key.startswith("loss_")):
        loss.zero_grad()
        loss(data)[key].backward()
        reached = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
        assert reached == {REACHES[key] if functional else REACHES[key].removesuffix("_params")}


def test_a_shared_trunk_is_left_to_the_actor():
    trunk = nn.Linear(3, 4)
    shared = TensorDictModule(trunk, ["observation"], ["hidden"])
    actor = make_actor()
    weight = TensorDictSequential(
        shared, TensorDictModule(nn.Sequential(nn.Linear(4, 1), nn.Sigmoid()), ["hidden"], ["w"])
    )
    net = TensorDictSequential(shared, TensorDictModule(nn.Linear(4, 2), ["hidden"], ["logits"]))
    student = ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
    loss = AE2RLoss(student, actor, weight, make_critic())
    loss(make_batch())["loss_prior_weight"].backward()
    assert trunk.weight.grad is None
    assert weight[1].module[0].weight.grad is not None
    loss(make_batch())["loss_prior"].backward()
    assert trunk.weight.grad is not None


@pytest.mark.parametrize("method", ADAPTIVE)
def test_the_shaped_critic_is_left_to_the_policy_loss(method):
    loss = make_ae2r(method, td_error="shaped")
    sum(value for key, value in loss(make_batch()).items() if key.startswith("loss_")).backward()
    assert "loss_prior_critic" not in loss.out_keys
    assert all(p.grad is None for p in loss.critic_network_params.parameters())


def test_the_teacher_never_changes():
    loss = make_ae2r()
    before = {name: p.clone() for name, p in loss.prior.named_parameters()}
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1, weight_decay=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        sum(value for key, value in loss(make_batch()).items() if key.startswith("loss_")).backward()
        optimizer.step()
    assert same_tensors(before, dict(loss.prior.named_parameters()))


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_the_auxiliary_loss_alone_teaches_the_best_action_of_the_teacher(kind):
    loss = make_ae2r("kickstart", kind)
    data = make_batch(kind, batch=(32,))
    optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), lr=0.05)
    for _ in range(300):
        optimizer.zero_grad()
        loss(data)["loss_prior"].backward()
        optimizer.step()
    prior_dist = loss.prior.get_dist(data.copy())
    best = prior_dist.log_prob(prior_dist.mode)
    torch.testing.assert_close(loss(data)["prior_cross_entropy"], -best.mean(), atol=0.2, rtol=0)


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_a_weight_of_one_is_e2r(reduction):
    actor, prior, critic, data = make_actor(), make_actor(), make_critic(), make_batch()
    e2r = AE2RLoss(actor, prior, method="e2r", reduction=reduction)
    ae2r = AE2RLoss(actor, prior, make_constant_weight(1.0), critic, reduction=reduction)
    assert torch.equal(e2r(data)["loss_prior"], ae2r(data)["loss_prior"])


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_a_weight_of_zero_has_no_gradient(kind):
    loss = make_ae2r(kind=kind, prior_weight=make_constant_weight(0.0))
    loss(make_batch(kind))["loss_prior"].backward()
    assert not any(p.grad.any() for p in loss.actor_network_params.parameters())


def test_the_batch_is_left_as_it_is():
    data = make_batch()
    before = data.clone()
    make_ae2r()(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()
