"""AVEC trains the critic on the variance of its residual, with PPO, A2C and the prior's PPO."""

from __future__ import annotations

import copy

import pytest
import torch
from objectives_cases import OBS, make_actor, make_batch, make_critic
from torch import nn
from torchrl.modules import ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss, ReinforceLoss

from torchrl_priors.objectives import AE2RLoss, AVECMixin, ClipPPOPriorLoss, ValueOffset


class AVECClipPPO(AVECMixin, ClipPPOLoss):
    pass


class AVECA2C(AVECMixin, A2CLoss):
    pass


class AVECClipPPOPrior(AVECMixin, ClipPPOPriorLoss):
    def __init__(self, actor, critic, functional=True, **kwargs):
        prior_loss = AE2RLoss(actor, make_actor(), method="kickstart", functional=functional)
        super().__init__(actor, critic, prior_loss, **kwargs)


LOSSES = {AVECClipPPO: ClipPPOLoss, AVECA2C: A2CLoss, AVECClipPPOPrior: ClipPPOLoss}
every_loss = pytest.mark.parametrize("loss_class", LOSSES, ids=lambda cls: cls.__name__)


def make_offset_critic(init=0.0):
    return ValueOperator(nn.Sequential(nn.Linear(OBS, 1), ValueOffset(init)), in_keys=["observation"])


def residual(critic, data):
    return critic(data.copy())["state_value"] - data["value_target"]


@pytest.mark.parametrize("functional", [True, False])
@every_loss
def test_loss_and_gradient_are_those_of_the_variance(loss_class, functional):
    critic, data = make_critic(), make_batch()
    loss = loss_class(make_actor(), critic, functional=functional)
    value = loss(data)["loss_critic"]
    error = residual(critic, data)
    variance = ((error - error.mean()) ** 2).mean()
    torch.testing.assert_close(value, variance)
    parameters = list(critic.parameters())
    for gradient, expected in zip(
        torch.autograd.grad(value, parameters), torch.autograd.grad(variance, parameters), strict=True
    ):
        torch.testing.assert_close(gradient, expected, atol=1e-6, rtol=1e-5)


@every_loss
def test_other_losses_are_those_of_the_parent(loss_class):
    actor, critic, data = make_actor(), make_critic(), make_batch()
    losses = loss_class(actor, critic)(data)
    expected = LOSSES[loss_class](actor, critic, loss_critic_type="l2")(data)
    for key in expected.keys() - {"loss_critic"}:
        torch.testing.assert_close(losses[key], expected[key])
    assert (losses["loss_critic"] - expected["loss_critic"]).abs() > 1e-3


def test_avec_of_reinforce_is_the_variance_of_the_residual():
    class AVECReinforce(AVECMixin, ReinforceLoss):
        pass

    critic, data = make_critic(), make_batch()
    value = AVECReinforce(make_actor(), critic)(data)["loss_value"]
    torch.testing.assert_close(value, residual(critic, data).var(correction=0))


@every_loss
def test_the_loss_does_not_see_a_constant(loss_class):
    data = make_batch()
    actor, critic = make_actor(), make_critic()
    before = loss_class(actor, critic)(data)["loss_critic"]
    critic.module.bias.data += 100
    torch.testing.assert_close(loss_class(actor, critic)(data)["loss_critic"], before, atol=1e-3, rtol=1e-4)


@every_loss
def test_reductions_and_coefficient(loss_class):
    critic, data = make_critic(), make_batch()
    error = residual(critic, data)
    each = (2.0 * (error - error.mean()) ** 2).squeeze(-1)
    for reduction, expected in (("none", each), ("sum", each.sum()), ("mean", each.mean())):
        loss = loss_class(make_actor(), critic, reduction=reduction, critic_coeff=2.0)
        torch.testing.assert_close(loss(data)["loss_critic"], expected)


@every_loss
def test_masked_steps_do_not_count(loss_class):
    critic, data = make_offset_critic(), make_batch()
    loss = loss_class(make_actor(), critic)
    mask = torch.tensor([True, True, False, True, False, True]).unsqueeze(-1)
    data["value_target"][~mask] = 1e6
    data["collector", "mask"] = mask
    error = residual(critic, data)[mask]
    torch.testing.assert_close(loss(data)["loss_critic"], error.var(correction=0))
    torch.testing.assert_close(loss.update_value_offset(data), -error.mean())


@every_loss
def test_value_clipping_still_works(loss_class):
    data = make_batch()
    critic = make_critic()
    data["state_value"] = critic(data.copy())["state_value"].detach() + 0.05
    losses = loss_class(make_actor(), critic, clip_value=0.2)(data)
    assert "value_clip_fraction" in losses
    assert torch.isfinite(losses["loss_critic"])


@every_loss
def test_the_batch_is_left_as_it_is(loss_class):
    data = make_batch()
    before = data.clone()
    loss_class(make_actor(), make_critic())(data)
    assert torch.equal(data["value_target"], before["value_target"])
    assert "state_value" not in data


@every_loss
def test_only_l2_has_a_variance(loss_class):
    with pytest.raises(ValueError, match="l2"):
        loss_class(make_actor(), make_critic(), loss_critic_type="smooth_l1")


@pytest.mark.parametrize("functional", [True, False])
@every_loss
def test_the_offset_centres_the_values_the_loop_sees(loss_class, functional):
    critic, data = make_offset_critic(init=3.0), make_batch(batch=(2, 4))
    loss = loss_class(make_actor(), critic, functional=functional)
    without = residual(critic, data) - 3.0
    offset = loss.update_value_offset(data)
    torch.testing.assert_close(offset, -without.mean())  # b = mean(target - f), whatever it was before
    torch.testing.assert_close(residual(critic, data).mean(), torch.tensor(0.0), atol=1e-6, rtol=0)
    again = loss.update_value_offset(data)
    torch.testing.assert_close(again, offset, atol=1e-6, rtol=0)


@every_loss
def test_the_offset_changes_no_gradient(loss_class):
    critic, data = make_offset_critic(), make_batch()
    loss = loss_class(make_actor(), critic)
    gradients = []
    for _ in range(2):
        loss.zero_grad()
        loss(data)["loss_critic"].backward()
        gradients.append(critic.module[0].weight.grad.clone())
        loss.update_value_offset(data)
    torch.testing.assert_close(*gradients)


@every_loss
def test_the_offset_is_in_the_state_dict(loss_class):
    loss, other = loss_class(make_actor(), make_offset_critic()), loss_class(make_actor(), make_offset_critic())
    data = make_batch()
    offset = loss.update_value_offset(data)
    other.load_state_dict(copy.deepcopy(loss.state_dict()))
    assert offset != 0
    torch.testing.assert_close(other.update_value_offset(data), offset)


@every_loss
def test_the_offset_survives_a_move(loss_class):
    critic = make_offset_critic()
    loss = loss_class(make_actor(), critic).to(torch.double)
    data = make_batch().apply(lambda x: x.double() if x.is_floating_point() else x)
    loss.update_value_offset(data)
    error = loss._mean_error(data)
    assert error.dtype == torch.double
    assert error.abs() < 1e-12


@every_loss
def test_an_offset_without_a_place_is_refused(loss_class):
    with pytest.raises(ValueError, match="ValueOffset"):
        loss_class(make_actor(), make_critic()).update_value_offset(make_batch())


def test_the_offset_is_not_trained_and_can_be_reset():
    layer = ValueOffset(2.0)
    assert not list(layer.parameters())
    layer.reset_parameters()
    assert layer(torch.zeros(3)).tolist() == [0.0, 0.0, 0.0]


@every_loss
def test_missing_targets_are_the_parents_error(loss_class):
    data = make_batch().exclude("value_target")
    with pytest.raises(KeyError, match="value_target"):
        loss_class(make_actor(), make_critic())(data)
