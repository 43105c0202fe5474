"""Where TorchRL trains with its PPO or A2C loss, ours stands in its place: what holds of that loss holds of ours."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from objectives_cases import (
    loss_names,
    make_actor,
    make_batch,
    make_constant_weight,
    make_critic,
    make_ppo_prior,
    make_weight,
    same_tensors,
    total,
)
from tensordict import TensorDict
from torchrl.objectives import A2CLoss, ClipPPOLoss, ValueEstimators
from torchrl.objectives.utils import SoftUpdate

from torchrl_priors import ActionPrior
from torchrl_priors.methods import METHODS
from torchrl_priors.objectives import AE2RLoss

KINDS = ["categorical", "one_hot", "normal"]
ESTIMATORS = [None, ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda, ValueEstimators.GAE]
WITH_A_LOSS = [name for name, spec in METHODS.items() if spec.auxiliary or spec.adaptive]
LEARNED = [name for name in WITH_A_LOSS if METHODS[name].adaptive]


@pytest.fixture(autouse=True)
def _without_warnings_of_made_up_batches():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def networks(kind: str) -> tuple[Any, Any, Any]:
    return make_actor(kind), make_critic(), ActionPrior(make_actor(kind))


def ours(actor: Any, critic: Any, prior: Any, method: str, **options: Any) -> Any:
    learned = {"prior_weight": make_weight(), "prior_critic": make_critic()} if method in LEARNED else {}
    return make_ppo_prior(actor, critic, prior, method=method, **learned, **options)


def sequences(kind: str) -> TensorDict:
    return make_batch(kind, (3, 6))


class TestPPO:
    @pytest.mark.parametrize("estimator", ESTIMATORS)
    @pytest.mark.parametrize("kind", KINDS)
    def test_every_value_estimator_gives_ppos_own_losses(self, kind, estimator):
        actor, critic, prior = networks(kind)
        data = sequences(kind).exclude("advantage", "value_target")
        theirs = ClipPPOLoss(actor, critic)
        mine = ours(actor, critic, prior, "kickstart", aux_coeff=0.0)
        for loss in (theirs, mine):
            if estimator is not None:
                loss.make_value_estimator(estimator)
        with torch.random.fork_rng(devices=[]):
            expected = theirs(data.copy())
        losses = mine(data.copy())
        names = loss_names(expected)
        assert same_tensors({n: losses[n] for n in names}, {n: expected[n] for n in names})

    @pytest.mark.parametrize("method", WITH_A_LOSS)
    @pytest.mark.parametrize("kind", KINDS)
    def test_every_network_that_is_trained_has_a_finite_gradient(self, kind, method):
        loss = ours(*networks(kind), method)
        total(loss(sequences(kind))).backward()
        trained = [p for p in loss.parameters() if p.requires_grad]
        assert trained
        assert all(p.grad is not None and p.grad.isfinite().all() for p in trained)
        assert any(p.grad.any() for p in trained)

    @pytest.mark.parametrize("clip_value", [False, True, 0.2])
    @pytest.mark.parametrize("method", ["kickstart", "ae2r"])
    def test_clipped_values_are_ppos(self, method, clip_value):
        actor, critic, prior = networks("normal")
        data = sequences("normal")
        data["state_value"] = torch.randn(3, 6, 1)
        expected = ClipPPOLoss(actor, critic, clip_value=clip_value)(data)
        losses = ours(actor, critic, prior, method, clip_value=clip_value)(data)
        assert torch.equal(losses["loss_critic"], expected["loss_critic"])

    @pytest.mark.parametrize("normalize", [False, True])
    @pytest.mark.parametrize("reduction", ["mean", "sum"])
    def test_policy_loss_and_entropy_are_ppos(self, reduction, normalize):
        actor, critic, prior = networks("categorical")
        data, options = sequences("categorical"), {"normalize_advantage": normalize, "entropy_coeff": 0.1}
        expected = ClipPPOLoss(actor, critic, reduction=reduction, **options)(data)
        losses = make_ppo_prior(
            actor, critic, prior, make_constant_weight(0.5), make_critic(), reduction=reduction, **options
        )(data)
        for name in ("loss_objective", "loss_entropy", "kl_approx", "clip_fraction", "ESS"):
            assert torch.equal(losses[name], expected[name]), name

    @pytest.mark.parametrize("method", WITH_A_LOSS)
    def test_a_loss_that_is_saved_and_loaded_is_the_same(self, method):
        actor, critic, prior = networks("categorical")
        loss, other = ours(actor, critic, prior, method), ours(*networks("categorical"), method)
        data = sequences("categorical")
        other.load_state_dict(loss.state_dict())
        first, second = loss(data), other(data)
        assert same_tensors(dict(first.items()), dict(second.items()))

    def test_selected_outputs_are_all_that_there_is(self):
        loss = ours(*networks("categorical"), "ae2r").select_out_keys("loss_objective", "loss_prior")
        assert set(loss(sequences("categorical")).keys()) == {"loss_objective", "loss_prior"}

    def test_ppo_prior_loss_has_no_target_networks_as_ppo_has_none(self):
        with pytest.raises(Exception, match=r"(?i)target"):
            SoftUpdate(ours(*networks("categorical"), "e2r"), eps=0.9)


class TestA2C:
    """A2C has no loss of ours in its place: an ``AE2RLoss`` stands beside it."""

    @pytest.mark.parametrize("method", WITH_A_LOSS)
    @pytest.mark.parametrize("kind", KINDS)
    def test_the_sum_has_the_gradients_of_both(self, kind, method):
        actor, critic, prior = networks(kind)
        data = sequences(kind)
        learned = (make_weight(), make_critic()) if method in LEARNED else ()
        theirs = A2CLoss(actor, critic, functional=False)
        mine = AE2RLoss(actor, prior, *learned, method=method, functional=False)
        parts = []
        for losses in (theirs(data), mine(data)):
            actor.zero_grad()
            total(losses).backward()
            zero = [torch.zeros_like(p) for p in actor.parameters()]
            parts.append(
                [z if p.grad is None else p.grad.clone() for p, z in zip(actor.parameters(), zero, strict=True)]
            )
        actor.zero_grad()
        (total(theirs(data)) + total(mine(data))).backward()
        for parameter, *expected in zip(actor.parameters(), *parts, strict=True):
            torch.testing.assert_close(parameter.grad, sum(expected))

    @pytest.mark.parametrize("estimator", ESTIMATORS)
    def test_a2cs_own_estimators_can_read_the_shaped_reward(self, estimator):
        actor, critic, _ = networks("categorical")
        data = sequences("categorical").exclude("advantage", "value_target")
        loss = A2CLoss(actor, critic)
        loss.set_keys(reward="shaped_reward")
        if estimator is not None:
            loss.make_value_estimator(estimator)
        shaped = loss(data.copy())
        data["next", "shaped_reward"] = data["next", "shaped_reward"] + 1
        assert not torch.equal(loss(data)["loss_critic"], shaped["loss_critic"])
