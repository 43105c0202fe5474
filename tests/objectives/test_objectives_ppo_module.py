"""ClipPPOPriorLoss as a module: parameters, state, options and the layout of its output."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives_cases import loss_names, make_batch, make_networks, make_ppo_loss, make_ppo_prior, same_tensors, total

from torchrl_priors.methods import METHODS


def test_every_parameter_is_listed_once():
    networks = make_networks()
    loss = make_ppo_prior(**networks)
    parameters = list(loss.parameters())
    assert len(parameters) == len(set(parameters))
    assert set(parameters) == {p for network in networks.values() for p in network.parameters()}


def test_parameters_stay_shared_after_a_move():
    loss = make_ppo_loss(td_error="shaped").to(torch.double)
    for name in ("actor_network_params", "critic_network_params"):
        mine, inner = (dict(getattr(x, name).named_parameters()) for x in (loss, loss.prior_loss))
        assert all(inner[key] is mine[key] and inner[key].dtype == torch.double for key in mine)


@pytest.mark.parametrize("method", METHODS)
def test_ppo_prior_loss_of_tensors_is_that_of_the_tensordict(method):
    loss = make_ppo_loss(method)
    data = make_batch()
    data["raw_advantage"] = data["advantage"]
    kwargs = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    loss.in_keys = [*loss.in_keys, "advantage", "value_target"]
    values = loss(**kwargs, advantage=data["advantage"], value_target=data["value_target"])
    expected = loss(data)
    for key, value in zip(loss.out_keys, values, strict=True):
        torch.testing.assert_close(value, expected[key])


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
@pytest.mark.parametrize("method", ["ae2r", "aligned"])
def test_reduced_losses_of_ppo_prior_loss_are_those_of_its_steps(method, batch):
    loss = make_ppo_loss(method, reduction="none")
    data = make_batch(batch=batch)
    each = loss(data)
    for key in loss_names(each):
        assert each[key].shape == batch
    for reduction in ("mean", "sum"):
        loss.reduction = reduction  # also after construction
        reduced = loss(data)
        for key in loss_names(each):
            torch.testing.assert_close(reduced[key], getattr(each[key], reduction)())


def test_mask_key_reaches_both_losses():
    loss = make_ppo_loss(normalize_advantage=False)
    data = make_batch()
    mask = torch.tensor([True, True, False, True, False, True])
    expected = loss(data[mask])
    data["valid"] = mask.unsqueeze(-1)
    loss.loss_mask_key = "valid"
    losses = loss(data)
    for key in loss_names(expected):
        torch.testing.assert_close(losses[key], expected[key])


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("td_error", ["original", "shaped"])
def test_state_dict_restores_the_losses(td_error, functional):
    loss, other = (make_ppo_loss(td_error=td_error, functional=functional) for _ in range(2))
    data = make_batch()
    other.load_state_dict(copy.deepcopy(loss.state_dict()))
    assert same_tensors(loss(data).to_dict(), other(data).to_dict())


def test_deep_copy_keeps_parameters_shared_inside():
    twin = copy.deepcopy(make_ppo_loss())
    for p in twin.actor_network_params.parameters():
        p.data.zero_()
    assert not any(p.any() for p in twin.prior_loss.actor_network_params.parameters())


@pytest.mark.parametrize("functional", [True, False])
def test_reset_leaves_the_prior_alone(functional):
    networks = make_networks()
    before = {name: copy.deepcopy(network.state_dict()) for name, network in networks.items()}
    make_ppo_prior(**networks, functional=functional).reset_parameters_recursive()
    for name, network in networks.items():
        for key, value in network.state_dict().items():
            assert torch.equal(value, before[name][key]) == (name == "prior")


def test_compiled_forward_gives_the_same_numbers():
    loss, data = make_ppo_loss(kind="normal"), make_batch("normal")
    expected = loss(data)
    torch._dynamo.reset()
    losses = torch.compile(loss, backend="aot_eager", fullgraph=True)(data)
    for key in loss_names(expected):
        torch.testing.assert_close(losses[key], expected[key])
    total(losses).backward()
    assert all(p.grad is not None for p in loss.actor_network_params.parameters())


def test_options_of_ppo_pass_through():
    loss = make_ppo_loss(clip_epsilon=0.3, critic_coeff=0.5, entropy_bonus=False, loss_critic_type="l2")
    assert loss.clip_epsilon == pytest.approx(0.3)
    assert loss.critic_coeff == 0.5
    assert "loss_entropy" not in loss(make_batch())
    loss.critic_coeff, loss.prior_loss.aux_coeff = 0.25, 0.1
    assert loss.prior_loss.aux_coeff == pytest.approx(0.1)


def test_bad_options_of_ppo_prior_loss_are_refused():
    with pytest.raises(ValueError, match="Unknown method"):
        make_ppo_loss("ppo")
    with pytest.raises(ValueError, match="pass critic_network"):
        make_ppo_loss(prior_critic=None)
