"""The trainer hook and the transforms of a loss: same networks, settings and keys as the loss."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from objectives_cases import make_actor, make_critic, make_ppo_prior
from torch import nn

from torchrl_priors import ActionPrior, AE2RLoss, ClipPPOPriorLoss, PriorShaping, PriorWeight, prior_transforms


def make_loss(method: str = "ae2r", **kwargs: object) -> ClipPPOPriorLoss:
    weight = PriorWeight(nn.Linear(3, 1))
    prior = ActionPrior(make_actor())
    return make_ppo_prior(make_actor(), make_critic(), prior, weight, make_critic(), method=method, **kwargs)


@pytest.mark.parametrize("functional", [True, False])
def test_transforms_share_the_networks_of_the_loss(functional: bool) -> None:
    loss = make_loss(functional=functional)
    log_prob, bonus = prior_transforms(loss)
    assert log_prob.prior is loss.prior_loss.prior
    assert log_prob.__dict__["actor"] is loss.actor_network
    assert bonus.__dict__["prior_weight"] is loss.prior_loss.prior_weight


def test_transforms_have_the_settings_of_the_loss() -> None:
    loss = make_loss("aer", bonus_coeff=0.25, num_samples=3, prior_in_batch=True)
    log_prob, bonus = prior_transforms(loss)
    assert (log_prob.num_samples, log_prob.keep_params) == (3, True)
    assert (bonus.shift, bonus.bonus_coeff.item()) == ("current", 0.25)


def test_transforms_have_the_keys_of_the_loss() -> None:
    loss = make_loss()
    loss.set_keys(done=("agent", "done"), terminated=("agent", "terminated"), reward=("agent", "shaped"))
    loss.prior_loss.set_keys(**{name: ("agent", name) for name in ("reward", "prior_log_prob", "prior_bonus")})
    log_prob, bonus = prior_transforms(loss)
    assert log_prob.out_keys == [("agent", "prior_log_prob")]
    assert (log_prob.done_key, log_prob.terminated_key) == (("next", "agent", "done"), ("next", "agent", "terminated"))
    assert bonus.in_keys == [("next", "agent", "reward")]
    assert bonus.out_keys == [("next", "agent", "prior_bonus"), ("next", "agent", "shaped")]


def test_the_kl_penalty_of_a_loss_reads_the_students_log_probability() -> None:
    loss = make_loss("kl_penalty")
    loss.set_keys(sample_log_prob=("agent", "log_prob"))
    bonus = prior_transforms(loss)[1]
    assert (bonus.shift, bonus.relative, bonus.student_log_prob_key) == ("current", True, ("agent", "log_prob"))


@pytest.mark.parametrize("method", ["none", "kickstart"])
def test_methods_without_a_bonus_leave_the_reward_as_it_is(method: str) -> None:
    bonus = prior_transforms(make_loss(method))[1]
    assert bonus.shift == "none"
    assert bonus.out_keys[1] == ("next", "shaped_reward")


def test_settings_of_the_caller_win() -> None:
    loss = AE2RLoss(make_actor(), ActionPrior(make_actor()), method="e2r")
    assert prior_transforms(loss, boundary="zero")[0].boundary == "zero"


def test_prior_shaping_refuses_another_loss() -> None:
    with pytest.raises(TypeError, match=r"Expected an AE2RLoss, .* got Linear"):
        prior_transforms(nn.Linear(1, 1))


def test_hook_refuses_what_it_cannot_shape() -> None:
    with pytest.raises(RuntimeError, match="register"):
        PriorShaping()(None)
    with pytest.raises(ValueError, match="async_collection=False"):
        PriorShaping().register(SimpleNamespace(async_collection=True, loss_module=make_loss()))
