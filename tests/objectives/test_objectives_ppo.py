"""ClipPPOPriorLoss is ClipPPOLoss and AE2RLoss in one, and plain PPO where the prior counts for nothing."""

from __future__ import annotations

import copy
import warnings

import pytest
import torch
from objectives_cases import (
    gradients,
    loss_names,
    make_actor,
    make_batch,
    make_constant_weight,
    make_critic,
    make_networks,
    make_ppo_loss,
    make_ppo_prior,
    make_weight,
    same_tensors,
    total,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_priors.methods import METHODS
from torchrl_priors.objectives import AE2RLoss, AVECMixin, ClipPPOPriorLoss


def train(loss, data, networks, steps=5):
    """A few optimiser steps: the losses and gradients of each, and the parameters at the end."""
    optimizers = [torch.optim.Adam(network.parameters(), lr=1e-2) for network in networks]
    history = []
    for _ in range(steps):
        for optimizer in optimizers:
            optimizer.zero_grad()
        losses = loss(data)
        total(losses).backward()
        history.append(
            ({key: losses[key].detach() for key in loss_names(losses)}, [gradients(n) for n in networks[:2]])
        )
        for optimizer in optimizers:
            optimizer.step()
    return history, [{name: p.detach().clone() for name, p in network.named_parameters()} for network in networks[:2]]


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("method", ["ae2r", "aer", "aligned"])
@pytest.mark.parametrize("kind", ["categorical", "one_hot", "normal"])
def test_a_weight_of_zero_is_plain_ppo_bit_by_bit(kind, method, functional):
    actor, critic, prior_critic, data = make_actor(kind), make_critic(), make_critic(), make_batch(kind)
    plain_actor, plain_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    options = {"functional": functional, "normalize_advantage": True, "entropy_coeff": 0.01}
    weight = make_constant_weight(0.0)
    loss = make_ppo_prior(actor, critic, make_actor(kind), weight, prior_critic, method=method, **options)
    plain = ClipPPOLoss(plain_actor, plain_critic, **options)
    history, parameters = train(loss, data, [actor, critic, prior_critic])
    plain_history, plain_parameters = train(plain, data, [plain_actor, plain_critic])
    for (losses, grads), (plain_losses, plain_grads) in zip(history, plain_history, strict=True):
        assert same_tensors({key: losses[key] for key in plain_losses}, plain_losses)
        assert all(same_tensors(*pair) for pair in zip(grads, plain_grads, strict=True))
        assert losses.get("loss_prior", 0.0) == 0.0
    assert all(same_tensors(*pair) for pair in zip(parameters, plain_parameters, strict=True))


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_a_weight_of_one_is_e2r_bit_by_bit(kind):
    actor, critic, prior, data = make_actor(kind), make_critic(), make_actor(kind), make_batch(kind)
    twin_actor, twin_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    ae2r = make_ppo_prior(actor, critic, prior, make_constant_weight(1.0), make_critic(), method="ae2r")
    e2r = make_ppo_prior(twin_actor, twin_critic, prior, method="e2r")
    history, parameters = train(ae2r, data, [actor, critic])
    e2r_history, e2r_parameters = train(e2r, data, [twin_actor, twin_critic])
    for (losses, grads), (e2r_losses, e2r_grads) in zip(history, e2r_history, strict=True):
        assert same_tensors({key: losses[key] for key in e2r_losses}, e2r_losses)
        assert all(same_tensors(*pair) for pair in zip(grads, e2r_grads, strict=True))
    assert all(same_tensors(*pair) for pair in zip(parameters, e2r_parameters, strict=True))


@pytest.mark.parametrize("method", ["e2r", "kickstart", "ae2r", "aligned"])
def test_the_teacher_changes_the_students_gradient(method):
    networks, data = make_networks(), make_batch()
    total(ClipPPOLoss(networks["actor"], networks["critic"])(data)).backward()
    plain = [gradients(networks[name]) for name in ("actor", "critic")]
    for network in networks.values():
        network.zero_grad()
    total(make_ppo_prior(**networks, method=method)(data)).backward()
    actor, critic = (gradients(networks[name]) for name in ("actor", "critic"))
    assert not any(torch.equal(actor[name], plain[0][name]) for name in actor)
    assert same_tensors(critic, plain[1])


def test_the_teacher_of_ppo_prior_loss_never_changes():
    networks, data = make_networks(), make_batch()
    before = copy.deepcopy(dict(networks["prior"].named_parameters()))
    loss = make_ppo_prior(**networks)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=0.1, weight_decay=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        total(loss(data)).backward()
        optimizer.step()
    assert same_tensors(before, dict(networks["prior"].named_parameters()))


REACHED = {
    "loss_objective": {"actor"},
    "loss_entropy": {"actor"},
    "loss_critic": {"critic"},
    "loss_prior": {"actor"},
    "loss_prior_weight": {"prior_weight"},
    "loss_prior_critic": {"prior_critic"},
}


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", METHODS)
def test_each_loss_reaches_its_own_network_only(method, td_error, functional):
    networks, data = make_networks(), make_batch()
    loss = make_ppo_prior(**networks, method=method, td_error=td_error, functional=functional)
    for key in loss_names(loss(data)):
        for network in networks.values():
            network.zero_grad()
        loss(data)[key].backward()
        reached = {
            name for name, net in networks.items() if any(p.grad is not None and p.grad.any() for p in net.parameters())
        }
        assert reached == REACHED[key]


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", METHODS)
def test_losses_of_ppo_prior_loss_are_those_of_the_two_modules(method, td_error):
    networks, data = make_networks(), make_batch()
    losses = make_ppo_prior(**networks, method=method, td_error=td_error, aux_coeff=0.3, gamma=0.9)(data)
    ppo = ClipPPOLoss(networks["actor"], networks["critic"])(data)
    critic = networks["prior_critic" if td_error == "original" else "critic"]
    prior = AE2RLoss(
        *(networks[name] for name in ("actor", "prior", "prior_weight")),
        critic,
        method=method,
        td_error=td_error,
        aux_coeff=0.3,
        gamma=0.9,
    )(data)
    assert same_tensors(losses.to_dict(), {**ppo.to_dict(), **prior.to_dict()})


def test_an_unshaped_batch_is_refused_rather_than_trained_on():
    """Without an advantage the loss estimates its own: from the shaped reward, or not at all."""
    data = make_batch().exclude("advantage", "value_target", ("next", "shaped_reward"))
    with pytest.raises((KeyError, AttributeError, RuntimeError, TypeError)):
        make_ppo_loss("e2r")(data)
    make_ppo_loss("kickstart")(data)  # no bonus: the reward is the reward


def test_own_advantages_are_estimated_from_the_shaped_reward():
    networks, data = make_networks(), make_batch(batch=(2, 5))
    data = data.exclude("advantage", "value_target")
    loss = make_ppo_prior(**networks, gamma=0.7)
    gae = GAE(gamma=0.7, lmbda=0.95, value_network=networks["critic"])
    gae.set_keys(reward="shaped_reward")
    expected = loss(gae(data.copy()))
    losses = loss(data)
    for key in loss_names(expected):
        torch.testing.assert_close(losses[key], expected[key])


def test_one_discount_for_the_advantage_and_the_weight():
    loss = make_ppo_loss(gamma=0.7)
    loss.make_value_estimator()
    assert loss.value_estimator.gamma == pytest.approx(0.7)
    loss.make_value_estimator(gamma=0.5)
    assert loss.prior_loss.gamma == 0.5
    assert loss.gamma == 0.5


def test_reward_key_that_hides_the_bonus_warns():
    with pytest.warns(UserWarning, match="do not see the prior's bonus"):
        make_ppo_loss("e2r").set_keys(reward="reward")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_ppo_loss("kickstart").set_keys(reward="reward")
        make_ppo_loss("e2r").set_keys(reward="my_reward")


def test_each_loss_has_its_keys_and_the_end_is_one():
    loss = make_ppo_loss()
    loss.set_keys(reward=("a", "shaped"), terminated="end", value="v")
    loss.prior_loss.set_keys(reward=("a", "raw"), prior_log_prob="lp", prior_weight="w")
    assert loss.prior_loss.tensor_keys.terminated == "end"
    assert (loss.tensor_keys.reward, loss.prior_loss.tensor_keys.value) == (("a", "shaped"), "state_value")
    assert {("next", "a", "raw"), ("next", "lp"), ("next", "end")} <= set(loss.in_keys)
    assert ("next", "reward") not in loss.in_keys
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(prior_log_prob="lp")


@pytest.mark.parametrize("td_error", ["original", "shaped"])
def test_another_student_or_critic_in_the_prior_loss_is_refused(td_error):
    actor, critic = make_actor(), make_critic()
    options = {"prior_weight": make_weight(), "critic_network": make_critic(), "td_error": td_error}
    with pytest.raises(ValueError, match="student of the prior's loss is another"):
        ClipPPOPriorLoss(actor, critic, AE2RLoss(make_actor(), make_actor(), **options))
    if td_error == "shaped":
        with pytest.raises(ValueError, match="critic of the prior's loss is another"):
            ClipPPOPriorLoss(actor, critic, AE2RLoss(actor, make_actor(), **options))


def test_avec_and_ppo_prior_loss_combine():
    class Loss(AVECMixin, ClipPPOPriorLoss):
        pass

    networks, data = make_networks(), make_batch()
    losses = make_ppo_prior(**networks, loss_class=Loss)(data)
    plain = make_ppo_prior(**networks, loss_critic_type="l2")(data)
    error = networks["critic"](data.copy())["state_value"] - data["value_target"]
    torch.testing.assert_close(losses["loss_critic"], error.var(correction=0))
    for key in loss_names(plain) - {"loss_critic"}:
        assert torch.equal(losses[key], plain[key])
