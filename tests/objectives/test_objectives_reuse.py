"""What the losses reuse, they would have computed themselves: the prior's advice, the student, the critic's values."""

from __future__ import annotations

import pytest
import torch
from objectives_cases import make_actor, make_batch, make_critic, make_ppo_prior, make_weight
from torchrl.objectives import ClipPPOLoss

from torchrl_priors import ActionPrior, PriorLogProb, RandomDegradation, StructuralDegradation
from torchrl_priors.objectives import AE2RLoss, AVECMixin

PRIORS = {
    "plain": lambda prior: prior,
    "random": lambda prior: RandomDegradation(prior, 0.5, seed=0),
    "structural": lambda prior: StructuralDegradation(prior, lambda td: td["observation"][..., 0] > 0),
}
every_prior = pytest.mark.parametrize("degrade", PRIORS.values(), ids=PRIORS)
every_kind = pytest.mark.parametrize("kind", ["categorical", "one_hot", "normal", "tanh_normal"])


class AVECClipPPO(AVECMixin, ClipPPOLoss):
    pass


def count_calls(module):
    calls = []
    module.register_forward_hook(lambda *_: calls.append(1))
    return calls


def scored_batch(prior, kind, **kwargs):
    batch = make_batch(kind, batch=(2, 5))
    batch["observation"][:, 1:] = batch["next", "observation"][:, :-1]  # a rollout
    return PriorLogProb(prior, time_dim=1, boundary="zero", **kwargs)(batch)


def make_losses(actor, prior):
    nets = (make_weight(), make_critic())
    return [AE2RLoss(actor, prior, *nets, num_samples=2, prior_in_batch=reuse) for reuse in (False, True)]


@every_prior
@every_kind
def test_advice_in_the_batch_gives_the_same_losses_without_a_call_of_the_prior(kind, degrade):
    teacher = ActionPrior(make_actor(kind))
    prior = degrade(teacher)
    batch = scored_batch(prior, kind, keep_params=True)
    running, reusing = make_losses(make_actor(kind), prior)
    torch.manual_seed(1)
    expected = running(batch)
    calls = count_calls(teacher.module.module[0])
    torch.manual_seed(1)
    losses = reusing(batch.select(*reusing.in_keys, ("next", "prior_bonus")))
    assert not calls
    running(batch)
    assert calls
    assert losses.keys() == expected.keys()
    for key, value in expected.items():
        assert torch.equal(losses[key], value), key


def test_a_loss_that_reuses_parameters_reads_them_instead_of_what_the_prior_reads():
    prior = ActionPrior(make_actor("normal", observation="raw"))
    running, reusing = make_losses(make_actor("normal"), prior)
    assert "raw" in running.in_keys
    assert "raw" not in reusing.in_keys
    assert {("prior", "loc"), ("prior", "scale")} <= set(reusing.in_keys)


def test_advice_is_kept_on_demand_only():
    prior = ActionPrior(make_actor("normal"))
    assert "prior" not in scored_batch(prior, "normal")
    batch = scored_batch(prior, "normal", keep_params=True)
    for name in ("loc", "scale"):
        assert torch.equal(batch["prior", name], getattr(prior.get_dist(batch).base_dist, name))
    assert "prior" not in batch["next"]


def test_missing_advice_says_what_to_run():
    _, reusing = make_losses(make_actor(), ActionPrior(make_actor()))
    with pytest.raises(KeyError, match="keep_params=True"):
        reusing(make_batch())


def test_only_an_action_prior_says_where_its_advice_is():
    with pytest.raises(ValueError, match="ActionPrior"):
        make_losses(make_actor(), make_actor())


@pytest.mark.parametrize("functional", [True, False])
def test_the_student_runs_once_and_is_forgotten(functional):
    loss = make_ppo_prior(make_actor(), make_critic(), make_actor(), method="kickstart", functional=functional)
    calls = count_calls(loss.actor_network.module[0])
    loss(make_batch())
    assert len(calls) == 1
    assert loss._student is None
    with pytest.raises(KeyError):
        loss(make_batch().exclude("value_target"))
    assert loss._student is None


def test_delayed_parameters_are_not_the_students():
    torch.manual_seed(0)
    actor, critic, prior = make_actor(), make_critic(), make_actor()
    loss = make_ppo_prior(actor, critic, prior, method="kickstart", delay_actor=True)
    batch = make_batch()
    for parameter in loss.actor_network_params.values(True, True):
        parameter.data += 1.0 + torch.rand_like(parameter)  # the target parameters stay behind
    losses = loss(batch)
    assert losses["kl_approx"].abs() > 1e-3
    torch.testing.assert_close(losses["loss_prior"], AE2RLoss(actor, prior, method="kickstart")(batch)["loss_prior"])


@pytest.mark.parametrize("functional", [True, False])
def test_avec_runs_the_critic_of_ppo_once(functional):
    loss = AVECClipPPO(make_actor(), make_critic(), functional=functional)
    calls = count_calls(loss.critic_network.module)
    loss(make_batch())
    assert len(calls) == 1
    assert loss._steps is None
