"""Claims about the reward bonus."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from trajectories import ACTIONS, ACTOR_LOGITS, PRIOR_LOGITS, STATES, actor, prior, trajectories

from torchrl_priors.methods import METHODS
from torchrl_priors.prior_weight import PriorWeight
from torchrl_priors.transforms import PriorBonus, PriorLogProb


@pytest.fixture
def batch() -> TensorDict:
    return PriorLogProb(prior(), actor(), time_dim=1)(trajectories(3, 8, ids=True))


@pytest.fixture
def weight() -> PriorWeight:
    weight = PriorWeight.table(STATES)
    nn.init.normal_(next(weight.parameters()))
    return weight


def at(weight: PriorWeight, state: torch.Tensor) -> torch.Tensor:
    (logits,) = weight.parameters()
    return logits[state].sigmoid().detach()


def test_next_weighs_the_advice_on_the_next_state(batch: TensorDict, weight: PriorWeight) -> None:
    PriorBonus(weight)(batch)
    expected = at(weight, batch["next", "state"]) * batch["next", "prior_log_prob"]
    torch.testing.assert_close(batch["next", "prior_bonus"], expected)
    terminated = batch["next", "terminated"]
    assert terminated.any()
    assert (batch["next", "prior_bonus"][terminated] == 0).all()
    assert (batch["next", "prior_bonus"][~terminated] != 0).any()


def test_current_weighs_the_advice_on_the_state(batch: TensorDict, weight: PriorWeight) -> None:
    PriorBonus(weight, shift="current")(batch)
    torch.testing.assert_close(batch["next", "prior_bonus"], at(weight, batch["state"]) * batch["prior_log_prob"])
    assert (batch["next", "prior_bonus"][batch["next", "terminated"]] != 0).any()


def test_terminal_observations_need_not_be_valid() -> None:
    batch = trajectories(4, ends=1.0)
    batch["next", "prior_log_prob"] = torch.zeros(4, 1)
    batch["next", "observation"] = torch.full((4, 2), torch.nan)
    PriorBonus(PriorWeight(nn.Linear(2, 1)))(batch)
    assert torch.equal(batch["next", "shaped_reward"], batch["next", "reward"])


def test_reward_is_never_touched(batch: TensorDict, weight: PriorWeight) -> None:
    before = batch.clone()
    PriorBonus(weight, bonus_coeff=0.25)(batch)
    assert (batch.select(*before.keys(True, True)) == before).all()
    assert set(batch.keys(True, True)) - set(before.keys(True, True)) == {
        ("next", "prior_bonus"),
        ("next", "shaped_reward"),
    }
    expected = before["next", "reward"] + 0.25 * batch["next", "prior_bonus"]
    torch.testing.assert_close(batch["next", "shaped_reward"], expected)


def test_no_weight_is_a_weight_of_one(batch: TensorDict) -> None:
    without = PriorBonus()(batch.clone())
    with_one = PriorBonus(PriorWeight.constant(1.0))(batch.clone())
    assert (without == with_one).all()


def test_weight_of_zero_leaves_the_reward_bitwise(batch: TensorDict) -> None:
    PriorBonus(PriorWeight.constant(0.0))(batch)
    assert torch.equal(batch["next", "shaped_reward"], batch["next", "reward"])


def test_weight_is_evaluated_anew_at_each_call(batch: TensorDict, weight: PriorWeight) -> None:
    transform = PriorBonus(weight)
    first = transform(batch)["next", "prior_bonus"].clone()
    next(weight.parameters()).data.sub_(1.0)
    second = transform(batch)["next", "prior_bonus"]
    advised = first != 0
    assert (second.abs() < first.abs())[advised].all()


def test_coefficient_can_be_scheduled(batch: TensorDict) -> None:
    transform = PriorBonus(bonus_coeff=1.0)
    transform.bonus_coeff.fill_(0.0)
    assert torch.equal(transform(batch)["next", "shaped_reward"], batch["next", "reward"])
    other = PriorBonus()
    other.load_state_dict(transform.state_dict())
    assert other.bonus_coeff == 0


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_its_bonus(batch: TensorDict, weight: PriorWeight, method: str) -> None:
    batch["action_log_prob"] = own = -torch.rand(batch.shape)
    bonus = PriorBonus.from_method(method, weight)(batch)["next", "prior_bonus"]
    following, current = batch["next", "prior_log_prob"], batch["prior_log_prob"]
    expected = {
        "er": current,
        "e2r": following,
        "aer": at(weight, batch["state"]) * current,
        "ae2r": at(weight, batch["next", "state"]) * following,
        "kl_penalty": current - own.unsqueeze(-1),
    }.get(method, torch.zeros_like(current))
    torch.testing.assert_close(bonus, expected)


@pytest.mark.parametrize("trailing", [False, True])
def test_a_relative_bonus_is_minus_the_divergence_in_the_mean(batch: TensorDict, trailing: bool) -> None:
    log_prob = ACTOR_LOGITS[batch["state"], batch["action"]]
    batch["action_log_prob"] = log_prob.unsqueeze(-1) if trailing else log_prob
    bonus = PriorBonus.from_method("kl_penalty")(batch)["next", "prior_bonus"]
    torch.testing.assert_close(bonus, batch["prior_log_prob"] - log_prob.unsqueeze(-1))
    # over all states and actions, by hand: the sum over the student's actions is -KL(pi || pi0)
    everything = torch.cartesian_prod(torch.arange(STATES), torch.arange(ACTIONS))
    state, action = everything.unbind(-1)
    full = trajectories(len(state))
    full["state"], full["action"] = state, action
    full["prior_log_prob"] = PRIOR_LOGITS[state, action].unsqueeze(-1)
    full["action_log_prob"] = ACTOR_LOGITS[state, action]
    bonus = PriorBonus(shift="current", relative=True)(full)["next", "prior_bonus"].view(STATES, ACTIONS)
    divergence = (ACTOR_LOGITS.exp() * (ACTOR_LOGITS - PRIOR_LOGITS)).sum(-1)
    torch.testing.assert_close((ACTOR_LOGITS.exp() * bonus).sum(-1), -divergence)


def test_a_relative_bonus_that_means_nothing_is_refused(batch: TensorDict) -> None:
    with pytest.raises(ValueError, match="needs shift='current', got 'next'"):
        PriorBonus(relative=True)
    with pytest.raises(KeyError, match=r"'action_log_prob'.*must return its log-prob"):
        PriorBonus(shift="current", relative=True)(batch)


def test_methods_without_a_bonus_need_no_log_probs() -> None:
    batch = PriorBonus.from_method("kickstart")(trajectories(4))
    assert torch.equal(batch["next", "shaped_reward"], batch["next", "reward"])


def test_adaptive_methods_need_a_weight() -> None:
    with pytest.raises(ValueError, match="pass prior_weight"):
        PriorBonus.from_method("ae2r")
    with pytest.raises(ValueError, match="Unknown method"):
        PriorBonus.from_method("a2er")


def test_bad_settings_and_batches_are_refused(batch: TensorDict) -> None:
    with pytest.raises(ValueError, match="shift must be"):
        PriorBonus(shift="previous")
    with pytest.raises(ValueError, match="must not be overwritten"):
        PriorBonus(out_keys=["bonus", ("next", "reward")])
    with pytest.raises(ValueError, match="one for the shaped reward"):
        PriorBonus(out_keys=["bonus"])
    with pytest.raises(KeyError, match="run PriorLogProb"):
        PriorBonus()(trajectories(4))
    batch["next", "reward"] = torch.zeros(3, 8, 2)
    with pytest.raises(ValueError, match="of shape"):
        PriorBonus()(batch)
