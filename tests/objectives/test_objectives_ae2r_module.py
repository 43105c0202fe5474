"""AE2RLoss as a TorchRL loss: keys, dispatch, reductions, masks, states, devices, compilation, errors."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives_cases import loss_names, make_actor, make_batch, make_critic, make_weight, same_tensors, total
from tensordict import TensorDict

from torchrl_priors.methods import METHODS, MethodSpec
from torchrl_priors.objectives import AE2RLoss

DEFAULT_KEYS = {
    "reward": "reward",
    "terminated": "terminated",
    "value": "state_value",
    "prior_weight": "prior_weight",
    "prior_log_prob": "prior_log_prob",
    "prior_bonus": "prior_bonus",
    "raw_advantage": "raw_advantage",
}


def make_loss(method="ae2r", kind="categorical", **kwargs):
    options = {"prior_weight": make_weight(), "critic_network": make_critic(), **kwargs}
    return AE2RLoss(make_actor(kind), make_actor(kind), method=method, **options)


def test_ae2r_loss_has_these_keys_by_default():
    loss = make_loss()
    assert {key: getattr(loss.tensor_keys, key) for key in DEFAULT_KEYS} == DEFAULT_KEYS
    assert set(loss.tensor_keys.__dataclass_fields__) == set(DEFAULT_KEYS)


def test_unknown_keys_of_ae2r_loss_are_refused():
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        make_loss().set_keys(advantages="advantage")


@pytest.mark.parametrize("method", ["ae2r", "aer", "aligned"])
@pytest.mark.parametrize(
    "name", [lambda key: f"my_{key}", lambda key: ("agents", "first", key)], ids=["flat", "nested"]
)
def test_renamed_keys_give_the_same_losses(method, name):
    loss = make_loss(method)
    data = make_batch()
    data["raw_advantage"] = data["advantage"] + 1
    expected = loss(data)

    weight, critic = make_weight(weight=name("prior_weight")), make_critic(value=name("state_value"))
    weight.load_state_dict(loss.get_stateful_net("prior_weight").state_dict())
    critic.load_state_dict(loss.get_stateful_net("critic_network").state_dict())
    renamed = AE2RLoss(loss.actor_network, loss.prior, weight, critic, method=method)
    renamed.set_keys(**{key: name(default) for key, default in DEFAULT_KEYS.items()})
    for key in ("reward", "terminated", "prior_log_prob", "prior_bonus"):
        data.rename_key_(("next", key), ("next", *(new if isinstance(new := name(key), tuple) else (new,))))
    for key in ("prior_log_prob", "raw_advantage"):
        data.rename_key_(key, name(key))
    losses = renamed(data)
    assert same_tensors(dict(losses.items()), dict(expected.items()))


def test_ae2r_loss_reads_nested_observations():
    keys = {"observation": ("agents", "observation")}
    loss = AE2RLoss(make_actor(**keys), make_actor(**keys), make_weight(**keys), make_critic(**keys))
    total(loss(make_batch(**keys))).backward()
    assert ("next", "agents", "observation") in loss.in_keys


@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", METHODS)
def test_in_keys_are_all_that_is_read(method, td_error):
    loss = make_loss(method, td_error=td_error)
    data = make_batch()
    data["raw_advantage"] = data["advantage"]
    data["next"].pop("prior_bonus")
    expected = loss(data)
    assert set(expected.keys()) == set(loss.out_keys)
    losses = loss(data.select(*loss.in_keys))
    assert same_tensors(dict(losses.items()), dict(expected.items()))
    for key in set(loss.in_keys) - {"raw_advantage"}:
        with pytest.raises((KeyError, ValueError, RuntimeError, AttributeError, TypeError)):
            loss(data.select(*(other for other in loss.in_keys if other != key)))


@pytest.mark.parametrize("method", ["e2r", "ae2r", "aer", "kickstart", "aligned"])
def test_ae2r_loss_of_tensors_is_that_of_the_tensordict(method):
    loss = make_loss(method)
    data = make_batch()
    data["raw_advantage"] = data["advantage"]
    expected = loss(data)
    kwargs = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    values = loss(**kwargs)
    values = values if isinstance(values, tuple) else (values,)
    for key, value in zip(loss.out_keys, values, strict=True):
        assert torch.equal(value, expected[key])


def test_dispatch_with_selected_out_keys():
    loss = make_loss()
    loss.select_out_keys("loss_prior", "loss_prior_weight")
    data = make_batch()
    kwargs = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys}
    first, second = loss(**kwargs)
    losses = make_loss()(data)
    assert first.shape == losses["loss_prior"].shape
    assert second.requires_grad


@pytest.mark.parametrize("batch", [(6,), (2, 3)])
@pytest.mark.parametrize("method", ["ae2r", "aer", "aligned", "kickstart"])
def test_reduced_losses_of_ae2r_are_those_of_its_steps(method, batch):
    loss = make_loss(method, reduction="none")
    data = make_batch(batch=batch)
    each = loss(data)
    for key in (key for key in loss.out_keys if key.startswith("loss_")):
        assert each[key].shape == batch
        for reduction in ("mean", "sum"):
            loss.reduction = reduction
            torch.testing.assert_close(loss(data)[key], getattr(each[key], reduction)())
    for key in (key for key in loss.out_keys if not key.startswith("loss_")):
        assert each[key].shape == ()
        assert not each[key].requires_grad


def test_masked_steps_do_not_count():
    loss = make_loss()
    data = make_batch()
    mask = torch.tensor([True, True, False, True, False, True]).unsqueeze(-1)
    expected = loss(data[mask.squeeze(-1)])
    data["collector", "mask"] = mask
    losses = loss(data)
    for key in (*loss.out_keys, "prior_bonus"):
        torch.testing.assert_close(losses[key], expected[key])


@pytest.mark.parametrize("functional", [True, False])
def test_state_dict_restores_the_losses(functional):
    loss, other = make_loss(functional=functional), make_loss(functional=functional, aux_coeff=3.0, gamma=0.5)
    data = make_batch()
    other.load_state_dict(copy.deepcopy(loss.state_dict()))
    assert same_tensors(dict(loss(data).items()), dict(other(data).items()))


def test_a_deep_copy_of_ae2r_loss_is_independent():
    loss = make_loss()
    twin = copy.deepcopy(loss)
    data = make_batch()
    assert same_tensors(dict(loss(data).items()), dict(twin(data).items()))
    for p in twin.parameters():
        p.data.zero_()
    assert not same_tensors(dict(loss(data).items()), dict(twin(data).items()))


@pytest.mark.parametrize("functional", [True, False])
def test_both_modes_give_the_same_losses_and_gradients(functional):
    networks = make_actor(), make_actor(), make_weight(), make_critic()
    data = make_batch()
    results = []
    for mode in (True, functional):
        for network in networks:
            network.zero_grad()
        loss = AE2RLoss(*networks, functional=mode)
        losses = loss(data)
        total(losses).backward()
        results.append(
            {
                **losses.detach().to_dict(),
                **{f"{i}.{n}": p.grad for i, net in enumerate(networks) for n, p in net.named_parameters()},
            }
        )
    assert same_tensors(*results)


@pytest.mark.parametrize("functional", [True, False])
def test_reset_leaves_the_prior_alone(functional):
    loss = make_loss(functional=functional)
    before = {name: p.clone() for name, p in loss.named_parameters()}
    loss.reset_parameters_recursive()
    for name, p in loss.named_parameters():
        assert torch.equal(p, before[name]) == name.startswith("prior.")


def test_reset_leaves_the_shaped_critic_alone():
    loss = make_loss(td_error="shaped")
    before = loss.critic_network_params.clone()
    loss.reset_parameters_recursive()
    assert (loss.critic_network_params == before).all()


def test_ae2r_loss_moves_to_another_dtype():
    loss = make_loss().to(torch.double)
    data = make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    losses = loss(data)
    assert all(losses[key].dtype == torch.double for key in loss_names(losses))
    total(losses).backward()
    assert all(p.dtype == torch.double for p in loss.parameters())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_ae2r_loss_moves_to_a_gpu():
    loss = make_loss()
    data = make_batch()
    expected = loss(data)
    losses = loss.to("cuda")(data.to("cuda"))
    for key in loss.out_keys:
        torch.testing.assert_close(losses[key].cpu(), expected[key])


def test_coefficients_can_be_scheduled():
    loss = make_loss()
    data = make_batch()
    before = loss(data)
    loss.aux_coeff, loss.weight_coeff, loss.critic_coeff = 0.5, 2.0, 0.0
    after = loss(data)
    torch.testing.assert_close(after["loss_prior"], 0.5 * before["loss_prior"])
    torch.testing.assert_close(after["loss_prior_weight"], 2.0 * before["loss_prior_weight"])
    assert after["loss_prior_critic"] == 0
    assert "aux_coeff" in loss.state_dict()


@pytest.mark.parametrize(("kind", "method"), [("categorical", "ae2r"), ("normal", "aligned")])
def test_compiled_forward_gives_the_same_numbers(kind, method):
    loss = make_loss(method, kind)
    data = make_batch(kind)
    expected = loss(data)
    torch._dynamo.reset()
    losses = torch.compile(loss, backend="aot_eager", fullgraph=True)(data)
    assert losses.keys() == expected.keys()
    for key in loss_names(expected):
        torch.testing.assert_close(losses[key], expected[key])
    total(losses).backward()


def test_own_settings_are_a_method():
    spec = MethodSpec(bonus="next", auxiliary=False, adaptive=True)
    losses = make_loss(spec)(make_batch())
    assert loss_names(losses) == {"loss_prior_weight", "loss_prior_critic"}


@pytest.mark.parametrize("method", ["none", "er"])
def test_methods_without_a_loss_have_none(method):
    data = make_batch()
    assert set(make_loss(method)(data).keys()) == {"prior_bonus"}
    data["next"].pop("prior_bonus")
    assert make_loss(method)(data).is_empty()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "a2er"}, "Unknown method"),
        ({"td_error": "raw"}, "td_error"),
        ({"weight_target": "return"}, "weight_target"),
        ({"gamma": 1.5}, "gamma"),
        ({"aux_coeff": "1"}, "aux_coeff"),
        ({"prior_weight": None}, "pass prior_weight"),
        ({"critic_network": None}, "of its own"),
        ({"critic_network": None, "td_error": "shaped"}, "that of the policy loss"),
        ({"method": "aligned", "weight_target": "td"}, "lacks"),
        ({"weight_target": "advantage", "td_error": "shaped"}, "has seen the bonus"),
    ],
)
def test_bad_options_of_ae2r_loss_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_loss(**options)


def test_a_batch_without_log_probs_says_what_to_run():
    data = make_batch()
    data["next"].pop("prior_log_prob")
    with pytest.raises(KeyError, match="PriorLogProb"):
        make_loss()(data)


def test_an_advantage_that_is_nowhere_says_where_to_put_it():
    with pytest.raises(KeyError, match="raw_advantage"):
        make_loss("aligned", critic_network=None)(make_batch())


def test_shapes_that_would_broadcast_are_refused():
    data = make_batch()
    data["next", "prior_log_prob"] = data["next", "prior_log_prob"].squeeze(-1)
    data["next", "terminated"] = data["next", "terminated"].squeeze(-1)
    with pytest.raises((ValueError, RuntimeError)):
        make_loss()(data)
    data = make_batch()
    data["raw_advantage"] = data["advantage"].squeeze(-1)
    with pytest.raises(ValueError, match="one shape"):
        make_loss("aligned")(data)


def test_a_prior_over_other_actions_is_refused():
    with pytest.raises(ValueError, match="same actions"):
        AE2RLoss(make_actor("categorical"), make_actor("normal"), method="kickstart")(make_batch())


def test_empty_batch_of_time_and_envs_is_read_elementwise():
    """The losses of a batch are those of its steps, whatever the shape of the batch."""
    loss = make_loss(reduction="none")
    data = make_batch(batch=(2, 3))
    flat = loss(data.reshape(-1))
    for key in ("loss_prior", "loss_prior_weight", "loss_prior_critic"):
        torch.testing.assert_close(loss(data)[key].flatten(), flat[key])


def test_output_is_a_tensordict_without_batch_size():
    losses = make_loss(reduction="none")(make_batch())
    assert isinstance(losses, TensorDict)
    assert losses.batch_size == ()
