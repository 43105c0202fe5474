"""AE2RLoss against a two-state MDP worked out by hand, and its cross-entropies."""

from __future__ import annotations

import math

import pytest
import torch
from objectives_cases import make_actor, make_ae2r, make_batch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from torchrl_priors.distributions import cross_entropy
from torchrl_priors.objectives import AE2RLoss


def table(values, out_key, head=None):
    """A module that looks its output up by a one-hot state."""
    linear = nn.Linear(2, len(values[0]), bias=False)
    linear.weight.data = torch.tensor(values).T.contiguous()
    return TensorDictModule(linear if head is None else nn.Sequential(linear, head), ["state"], [out_key])


def table_actor(probabilities):
    logits = torch.tensor(probabilities).log().tolist()
    return ProbabilisticActor(
        table(logits, "logits"), in_keys=["logits"], distribution_class=torch.distributions.Categorical
    )


@pytest.fixture
def two_states():
    """pi(s0) = (1/2, 1/2), pi(s1) = (3/4, 1/4); pi0(s0) = (1/4, 3/4), pi0(s1) = (1/2, 1/2); w = (1/4, 3/4); V = (1, 2).

    Two steps: from s0 to s1 with a reward of 1, from s1 to the end with a reward of 3; gamma is 1/2.
    """
    logit = math.log(3.0)  # sigmoid(log 3) = 3/4
    networks = {
        "actor_network": table_actor([[0.5, 0.5], [0.75, 0.25]]),
        "prior": table_actor([[0.25, 0.75], [0.5, 0.5]]),
        "prior_weight": table([[-logit], [logit]], "prior_weight", nn.Sigmoid()),
        "critic_network": ValueOperator(table([[1.0], [2.0]], "v").module, in_keys=["state"]),
    }
    state = torch.eye(2)
    data = TensorDict(
        {
            "state": state,
            "prior_log_prob": torch.tensor([[-1.0], [-2.0]]),
            "next": {
                "state": state.flip(0),
                "reward": torch.tensor([[1.0], [3.0]]),
                "terminated": torch.tensor([[False], [True]]),
                "prior_log_prob": torch.tensor([[-2.0], [0.0]]),
            },
        },
        [2],
    )
    return networks, data


def test_losses_of_ae2r_are_those_worked_out_by_hand(two_states):
    networks, data = two_states
    losses = AE2RLoss(**networks, gamma=0.5, reduction="none")(data)
    # step 0: (E - w(s1) (-2))^2 = (-1 + 1.5)^2; step 1 terminated: (E - 0)^2
    torch.testing.assert_close(losses["loss_prior_weight"], torch.tensor([0.25, 1.0]))
    torch.testing.assert_close(losses["loss_prior"], torch.tensor([0.25 * 0.836988, 0.75 * 0.693147]))
    torch.testing.assert_close(losses["loss_prior_critic"], torch.tensor([1.0, 1.0]))
    torch.testing.assert_close(losses["prior_td_error"], torch.tensor(1.0))
    torch.testing.assert_close(losses["prior_weight"], torch.tensor(0.5))
    torch.testing.assert_close(losses["prior_cross_entropy"], torch.tensor((0.836988 + 0.693147) / 2))
    # KL = H^X - H(pi): s0: 0.836988 - 0.693147; s1: 0.693147 - 0.562335
    torch.testing.assert_close(losses["prior_kl"], torch.tensor((0.143841 + 0.130812) / 2))


def test_gradient_of_the_prior_weight_by_hand(two_states):
    networks, data = two_states
    AE2RLoss(**networks, gamma=0.5)(data)["loss_prior_weight"].backward()
    # d/dw (E - w l)^2 = -2 l (E - w l) = 2 at s1, times w (1 - w) = 3/16, over 2 steps; none at s0, after the end
    gradient = networks["prior_weight"].module[0].weight.grad
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 2 * 0.1875 / 2]]))


def test_losses_of_aer_are_those_worked_out_by_hand(two_states):
    networks, data = two_states
    losses = AE2RLoss(**networks, method="aer", gamma=0.5, reduction="none")(data)
    # (-1 - 1/4 (-1))^2 and, at the terminating step too, (-1 - 3/4 (-2))^2
    torch.testing.assert_close(losses["loss_prior_weight"], torch.tensor([0.5625, 0.25]))
    assert "loss_prior" not in losses


def test_losses_of_aligned_are_those_worked_out_by_hand(two_states):
    networks, data = two_states
    losses = AE2RLoss(**networks, method="aligned", gamma=0.5, reduction="none")(data)
    # (A - w (log pi0 + H^X))^2 with A = delta = 1
    expected = torch.tensor([(1 - 0.25 * (-1 + 0.836988)) ** 2, (1 - 0.75 * (-2 + 0.693147)) ** 2])
    torch.testing.assert_close(losses["loss_prior_weight"], expected)
    # the auxiliary loss averages over the teacher's actions, see below
    torch.testing.assert_close(losses["loss_prior"], torch.tensor([0.25 * math.log(2.0), 0.75 * 0.836988]))
    data["raw_advantage"] = torch.tensor([[2.0], [4.0]])
    losses = AE2RLoss(**networks, method="aligned", gamma=0.5, reduction="none")(data)
    expected = torch.tensor([(2 - 0.25 * (-1 + 0.836988)) ** 2, (4 - 0.75 * (-2 + 0.693147)) ** 2])
    torch.testing.assert_close(losses["loss_prior_weight"], expected)


def test_annealed_kickstart_averages_over_the_teachers_actions_by_hand(two_states):
    networks, data = two_states
    loss = AE2RLoss(networks["actor_network"], networks["prior"], method="annealed_kickstart", reduction="none")
    losses = loss(data)
    # at s0: -(1/4 log 1/2 + 3/4 log 1/2) = log 2; at s1: -(1/2 log 3/4 + 1/2 log 1/4)
    expected = torch.tensor([math.log(2.0), -(math.log(0.75) + math.log(0.25)) / 2])
    torch.testing.assert_close(losses["loss_prior"], expected)
    torch.testing.assert_close(losses["prior_cross_entropy"], expected.mean())
    losses["loss_prior"].sum().backward()
    # by the logits of a state: pi - pi0
    (gradient,) = [value.grad for name, value in loss.named_parameters() if "actor" in name and value.grad is not None]
    torch.testing.assert_close(gradient, torch.tensor([[0.25, 0.25], [-0.25, -0.25]]))


def test_the_teachers_cross_entropy_of_gaussians_pulls_the_spread_to_the_teachers():
    loss, data = make_ae2r("annealed_kickstart", kind="normal"), make_batch("normal")
    student, teacher = (net.get_dist(data.copy()) for net in (loss.actor_network, loss.prior))
    expected = torch.distributions.kl_divergence(teacher, student) + teacher.entropy()
    torch.testing.assert_close(loss(data)["loss_prior"], expected.mean())


@pytest.mark.parametrize("kind", ["categorical", "normal", "tanh_normal"])
def test_a_share_of_the_entropy_leads_from_the_cross_entropy_to_the_divergence(kind):
    data, actor, prior = make_batch(kind), make_actor(kind), make_actor(kind)

    def loss(**options):
        module = AE2RLoss(actor, prior, method="kickstart", functional=False, num_samples=64, **options)
        torch.manual_seed(0)
        value = module(data)["loss_prior"]
        return value, torch.cat([g.flatten() for g in torch.autograd.grad(value, list(actor.parameters()))])

    (plain, _), (none, slope), (half, _), (full, end) = (
        loss(**options) for options in ({}, {"kl_share": 0.0}, {"kl_share": 0.5}, {"kl_share": 1.0})
    )
    divergence = cross_entropy(actor.get_dist(data), prior.get_dist(data), num_samples=64).mean()
    if kind != "tanh_normal":  # whose two parts are sampled apart
        entropy = actor.get_dist(data).entropy().mean()
        divergence = divergence - entropy
        torch.testing.assert_close(none, plain)
        torch.testing.assert_close(full, divergence)
        torch.testing.assert_close(half, (none + full) / 2)
        towards = torch.cat([g.flatten() for g in torch.autograd.grad(entropy, list(actor.parameters()))])
        torch.testing.assert_close(slope - end, towards)
    assert none.isfinite()
    assert full.isfinite()


def test_a_share_of_the_entropy_is_of_the_students_cross_entropy_only():
    with pytest.raises(ValueError, match="kl_share is for a cross-entropy of the student's actions"):
        make_ae2r("pull", kl_share=0.5)
    with pytest.raises(ValueError, match=r"kl_share must be in \[0, 1\], got 2"):
        make_ae2r("kickstart", kl_share=2)
    assert make_ae2r("pull").aux_coeff == pytest.approx(0.3)
    assert make_ae2r("pull", aux_coeff=0.1).aux_coeff == pytest.approx(0.1)
    assert make_ae2r("kickstart").aux_coeff == 1
