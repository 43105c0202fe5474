"""A compiled step does what the plain loop does: with PPO, with AVEC, with a prior, and with Adam's state."""

from __future__ import annotations

import copy
import shutil

import pytest
import torch
from objectives_cases import OBS, make_actor, make_batch, make_critic, make_ppo_prior
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_priors import ActionPrior, AE2RLoss, CallablePrior, PriorWeight
from torchrl_priors.objectives import AVECMixin, ClipPPOPriorLoss, CompiledStep, ValueOffset


class AVECClipPPO(AVECMixin, ClipPPOLoss):
    pass


class AVECClipPPOPrior(AVECMixin, ClipPPOPriorLoss):
    pass


def mlp():
    return nn.Sequential(nn.Linear(OBS, 8), nn.Tanh(), nn.Linear(8, 1))


def make_loss(kind="normal", method="ae2r", **kwargs):
    torch.manual_seed(0)
    actor = make_actor(kind, hidden=(8,))
    critic = ValueOperator(nn.Sequential(mlp(), ValueOffset(0.5)), in_keys=["observation"])
    kwargs = {"functional": False, "normalize_advantage": True, **kwargs}
    if method == "none":
        return AVECClipPPO(actor, critic, **kwargs)
    weight, raw_critic = PriorWeight(mlp()), ValueOperator(mlp(), in_keys=["observation"])
    prior = ActionPrior(make_actor(kind))
    return make_ppo_prior(actor, critic, prior, weight, raw_critic, AVECClipPPOPrior, method=method, **kwargs)


def make_adam(loss, lr=1e-2, **kwargs):
    """The actor in a group of its own."""
    actor = list(loss.actor_network.parameters())
    rest = [p for p in loss.parameters() if p.requires_grad and all(p is not q for q in actor)]
    return torch.optim.Adam([{"params": actor}, {"params": rest, "lr": 0.3 * lr}], lr=lr, **kwargs)


def make_data(kind="normal", steps=24):
    torch.manual_seed(1)
    batch = make_batch(kind, batch=(steps,))
    torch.manual_seed(2)
    return batch, [torch.randperm(steps)[:8] for _ in range(12)]


def plain_steps(loss, optimizer, batch, indices, max_grad_norm=0.5, select=lambda name: name.startswith("loss_")):
    reports = []
    for index in indices:
        optimizer.zero_grad()
        losses = loss(batch[index])
        sum(value for name, value in losses.items() if select(name)).backward()
        for group in optimizer.param_groups:
            if max_grad_norm is not None:
                nn.utils.clip_grad_norm_(group["params"], max_grad_norm)
        optimizer.step()
        reports.append({name: value.detach().mean() for name, value in losses.items()})
    return reports


def assert_same(loss, optimizer, other, other_optimizer, atol=2e-6):
    for (name, value), expected in zip(loss.state_dict().items(), other.state_dict().values(), strict=True):
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, expected, atol=atol, rtol=1e-4, msg=lambda m, name=name: f"{name}: {m}")
    states = (o.state_dict()["state"] for o in (optimizer, other_optimizer))
    for state, expected in zip(*(s.values() for s in states), strict=True):
        for name in state:
            torch.testing.assert_close(state[name], expected[name], atol=1e-4, rtol=1e-3)


def both(method="ae2r", kind="normal", select=None, backend="eager", max_grad_norm=0.5, **kwargs):
    loss, other = make_loss(kind, method, **kwargs), make_loss(kind, method, **kwargs)
    optimizer, other_optimizer = make_adam(loss), make_adam(other)
    step = CompiledStep(loss, optimizer, max_grad_norm=max_grad_norm, select=select, backend=backend)
    return (loss, optimizer, step), (other, other_optimizer)


@pytest.mark.parametrize("max_grad_norm", [None, 0.05], ids=["unclipped", "clipped"])
@pytest.mark.parametrize("kind", ["normal", "categorical"])
@pytest.mark.parametrize("method", ["none", "kickstart", "e2r", "ae2r", "aligned"])
def test_steps_are_those_of_the_plain_loop(method, kind, max_grad_norm):
    batch, indices = make_data(kind)
    batch["raw_advantage"] = batch["advantage"]
    (loss, optimizer, step), plain = both(method, kind, max_grad_norm=max_grad_norm)
    before = [parameter.clone() for parameter in optimizer.param_groups[0]["params"]]
    reports = step(batch, indices)
    expected = plain_steps(*plain, batch, indices, max_grad_norm)
    assert step.names == list(expected[0])
    for report, losses in zip(reports, expected, strict=True):
        torch.testing.assert_close(report, torch.stack(list(losses.values())), atol=1e-5, rtol=1e-4)
    # the last bias of an AVEC critic has no gradient but rounding, which Adam would blow up
    for module in (loss, plain[0]):
        module.critic_network.module[0][-1].bias.data.zero_()
    for opt in (optimizer, plain[1]):
        for parameter, state in list(opt.state.items()):
            if parameter.shape == (1,) or float(state["step"]) == 0:
                del opt.state[parameter]
    assert_same(loss, optimizer, *plain)
    assert all((p != q).any() for p, q in zip(optimizer.param_groups[0]["params"], before, strict=True))


@pytest.mark.skipif(shutil.which("g++") is None and shutil.which("clang++") is None, reason="no C++ compiler")
def test_the_compiled_graph_computes_what_was_recorded():
    """Without a prior, whose graph takes three times as long to compile: a test of the MuJoCo recipe compares that."""
    batch, indices = make_data()
    (_, _, step), _ = both("none")
    (loss, _, compiled), _ = both("none", backend="inductor")
    torch.testing.assert_close(compiled(batch, indices), step(batch, indices), atol=1e-5, rtol=1e-4)
    for value, expected in zip(loss.parameters(), step.loss.parameters(), strict=True):
        if value.shape != (1,):
            torch.testing.assert_close(value, expected, atol=2e-6, rtol=1e-4)


def test_the_loss_keeps_its_own_tensors():
    batch, indices = make_data()
    (loss, _, step), _ = both()
    before = [
        id(tensor) for module in loss.modules() for tensor in (*module._parameters.values(), *module._buffers.values())
    ]
    step(batch, indices)
    after = [
        id(tensor) for module in loss.modules() for tensor in (*module._parameters.values(), *module._buffers.values())
    ]
    assert before == after
    assert all(parameter.grad is None for parameter in loss.parameters())


def test_recording_draws_no_random_numbers_and_leaves_the_batch():
    batch, indices = make_data()
    (_, _, step), _ = both()
    before, state = batch.clone(), torch.get_rng_state()
    step(batch, indices)
    assert torch.equal(torch.get_rng_state(), state)
    assert (batch == before).all()
    assert set(batch.keys(True, True)) == set(before.keys(True, True))


def test_changes_from_outside_are_seen():
    batch, indices = make_data()
    (loss, optimizer, step), (other, other_optimizer) = both("kickstart")
    step(batch, indices[:1])
    plain_steps(other, other_optimizer, batch, indices[:1])
    for module, opt in ((loss, optimizer), (other, other_optimizer)):
        opt.param_groups[0]["lr"] = 0.1
        module.prior_loss.aux_coeff = 3.0
        module.critic_network.module[1].offset.fill_(-4.0)
    report = dict(zip(step.names, step(batch, indices[1:])[-1], strict=True))
    expected = plain_steps(other, other_optimizer, batch, indices[1:])[-1]
    for name, value in expected.items():
        torch.testing.assert_close(report[name], value, atol=1e-5, rtol=1e-4)


def test_a_selected_loss_trains_its_network_only():
    batch, indices = make_data()
    (loss, _, step), plain = both(select=lambda name: name == "loss_prior_weight")
    before = copy.deepcopy(loss)
    step(batch, indices)
    plain_steps(*plain, batch, indices, select=lambda name: name == "loss_prior_weight")
    for name, value in loss.named_parameters():
        if "prior_weight" in name:
            torch.testing.assert_close(value, plain[0].get_parameter(name), atol=1e-6, rtol=1e-4)
            assert (value != before.get_parameter(name)).any()
        else:
            assert torch.equal(value, before.get_parameter(name)), name


def test_a_compiled_step_goes_on_from_a_saved_state_bit_by_bit():
    batch, indices = make_data()
    (loss, optimizer, step), _ = both()
    step(batch, indices[:5])
    saved = copy.deepcopy((loss.state_dict(), optimizer.state_dict()))
    expected = step(batch, indices[5:])
    (other, other_optimizer, again), _ = both()
    again(batch, indices[:2])  # also where steps were taken before loading
    other.load_state_dict(saved[0])
    other_optimizer.load_state_dict(saved[1])
    assert torch.equal(again(batch, indices[5:]), expected)


def test_the_optimizer_can_go_on_without_it():
    batch, indices = make_data()
    (loss, optimizer, step), plain = both("kickstart")
    step(batch, indices[:6])
    losses = plain_steps(loss, optimizer, batch, indices[6:])[-1]
    expected = plain_steps(*plain, batch, indices)[-1]
    for name, value in losses.items():
        torch.testing.assert_close(value, expected[name], atol=1e-5, rtol=1e-4)


def test_minibatches_of_another_length():
    batch, _ = make_data()
    (_, _, step), plain = both("none")
    indices = torch.arange(24).split(10)
    reports, expected = step(batch, indices), plain_steps(*plain, batch, indices)
    assert [len(index) for index in indices] == [10, 10, 4]
    torch.testing.assert_close(reports[-1], torch.stack(list(expected[-1].values())), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("method", ["none", "ae2r"])
def test_sequences_are_taken_whole(method):
    torch.manual_seed(1)
    batch = make_batch("normal", batch=(12, 4))
    indices = [torch.randperm(12)[:5] for _ in range(4)]
    step, plain = both(method)[0][-1], both(method)[1]
    reports, expected = step(batch, indices), plain_steps(*plain, batch, indices)
    for report, losses in zip(reports, expected, strict=True):
        torch.testing.assert_close(report, torch.stack(list(losses.values())), atol=1e-5, rtol=1e-4)


def test_other_settings_of_adam_and_of_clipping_are_seen():
    batch, indices = make_data()
    (loss, optimizer, step), (other, other_optimizer) = both("kickstart")
    step(batch, indices[:3])
    plain_steps(other, other_optimizer, batch, indices[:3])
    for opt in (optimizer, other_optimizer):
        opt.param_groups[0].update(betas=(0.5, 0.9), eps=1e-3)
    step.max_grad_norm = 0.05
    step(batch, indices[3:])
    plain_steps(other, other_optimizer, batch, indices[3:], max_grad_norm=0.05)
    for parameter, expected in zip(loss.actor_network.parameters(), other.actor_network.parameters(), strict=True):
        torch.testing.assert_close(parameter, expected, atol=2e-6, rtol=1e-4)


def test_names_are_those_of_the_batch_at_hand():
    batch, indices = make_data()
    (_, _, step), _ = both("e2r")
    without = batch.exclude(("next", "prior_bonus"))
    names = []
    for data in (batch, without, batch):
        assert step(data, indices[:1]).shape[-1] == len(step.names)
        names.append("prior_bonus" in step.names)
    assert names == [True, False, True]


def test_a_prior_that_runs_python_on_the_values_is_refused_and_its_advice_in_the_batch_is_not():
    batch, indices = make_data()
    actor, critic = make_actor("normal"), make_critic()
    bot = CallablePrior(lambda observation: observation[:2], std=0.4)

    def step_of(**kwargs):
        loss = ClipPPOPriorLoss(actor, critic, AE2RLoss(actor, bot, method="kickstart", functional=False, **kwargs))
        return CompiledStep(loss, torch.optim.Adam(loss.parameters(), lr=0.0), backend="eager"), loss

    with pytest.raises(RuntimeError, match=r"Tensor\.numpy.*prior_in_batch=True"):
        step_of()[0](batch, indices)
    step, loss = step_of(prior_in_batch=True)
    reports = step(bot(batch), indices[:3])
    expected = [loss(batch[index])["prior_cross_entropy"] for index in indices[:3]]
    torch.testing.assert_close(reports[:, step.names.index("prior_cross_entropy")], torch.stack(expected))


def test_what_it_can_not_do_is_refused():
    loss = make_loss("normal", "none")
    with pytest.raises(TypeError, match="SGD"):
        CompiledStep(loss, torch.optim.SGD(loss.parameters()))
    with pytest.raises(ValueError, match="weight_decay"):
        CompiledStep(loss, torch.optim.Adam(loss.parameters(), weight_decay=0.1))
    functional = ClipPPOLoss(make_actor(), make_critic())
    with pytest.raises(ValueError, match="functional=False"):
        CompiledStep(functional, torch.optim.Adam(functional.parameters()))
    step = CompiledStep(loss, make_adam(loss), select=lambda name: False, backend="eager")
    with pytest.raises(ValueError, match="nothing to minimise"):
        step(*make_data())
