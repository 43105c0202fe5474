"""AE2RLoss against a two-state MDP worked out by hand, a loop over steps, and its claims about gradients."""

from __future__ import annotations

import math

import pytest
import torch
from objectives_cases import (
    loss_names,
    make_actor,
    make_batch,
    make_constant_weight,
    make_critic,
    make_weight,
    same_tensors,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import ProbabilisticActor, ValueOperator

from torchrl_priors.distributions import cross_entropy
from torchrl_priors.methods import METHODS
from torchrl_priors.objectives import AE2RLoss

ADAPTIVE = [name for name, spec in METHODS.items() if spec.adaptive]


def make_loss(method="ae2r", kind="categorical", **kwargs):
    options = {"prior_weight": make_weight(), "critic_network": make_critic(), **kwargs}
    return AE2RLoss(make_actor(kind), make_actor(kind), method=method, **options)


# ---------------------------------------------------------------------------------------------------------------------
# A two-state MDP, every number worked out by hand
# ---------------------------------------------------------------------------------------------------------------------


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


# E = V(s) - R - gamma V(s'): step 0: 1 - 1 - 2/2 = -1; step 1: 2 - 3 - 0 = -1, so delta = (1, 1).
# H^X: s0: -(log 1/4 + log 3/4) / 2 = 0.836988; s1: log 2 = 0.693147.


def test_ae2r_by_hand(two_states):
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


def test_aer_by_hand(two_states):
    networks, data = two_states
    losses = AE2RLoss(**networks, method="aer", gamma=0.5, reduction="none")(data)
    # (-1 - 1/4 (-1))^2 and, at the terminating step too, (-1 - 3/4 (-2))^2
    torch.testing.assert_close(losses["loss_prior_weight"], torch.tensor([0.5625, 0.25]))
    assert "loss_prior" not in losses


def test_aligned_by_hand(two_states):
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
    loss, data = make_loss("annealed_kickstart", kind="normal"), make_batch("normal")
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
        make_loss("pull", kl_share=0.5)
    with pytest.raises(ValueError, match=r"kl_share must be in \[0, 1\], got 2"):
        make_loss("kickstart", kl_share=2)
    assert make_loss("pull").aux_coeff == pytest.approx(0.3)
    assert make_loss("pull", aux_coeff=0.1).aux_coeff == pytest.approx(0.1)
    assert make_loss("kickstart").aux_coeff == 1


# ---------------------------------------------------------------------------------------------------------------------
# A loop over steps, every combination of settings
# ---------------------------------------------------------------------------------------------------------------------


def loop(loss, data, spec, td_error, weight_target, coeff):
    """The losses step by step in plain Python numbers."""
    out = {"loss_prior": [], "loss_prior_weight": [], "loss_prior_critic": []}
    with torch.no_grad():
        for step in data.unbind(0):
            here, there = step["observation"], step["next", "observation"]
            logits, prior_logits = (
                network.get_dist(TensorDict({"observation": here})).logits
                for network in (loss.actor_network, loss.prior)
            )
            entropy = -sum(math.exp(p) * q for p, q in zip(logits.tolist(), prior_logits.tolist(), strict=True))
            w, w_next = (loss.prior_weight.module(x).item() for x in (here, there))
            v, v_next = (loss.critic_network.module(x).item() for x in (here, there))
            alive = 0.0 if step["next", "terminated"].item() else 1.0
            target = step["next", "reward"].item() + 0.9 * alive * v_next
            log_prob, next_log_prob = step["prior_log_prob"].item(), step["next", "prior_log_prob"].item()
            if weight_target == "advantage":
                y, signal, at = target - v, log_prob + entropy, w
            elif spec.bonus == "next":
                y, signal, at = v - target, coeff * alive * next_log_prob, w_next
            else:
                y, signal, at = v - target, coeff * log_prob, w
            if spec.auxiliary:
                pull = entropy
                if spec.cross_entropy == "teacher":
                    pull = -sum(math.exp(q) * p for p, q in zip(logits.tolist(), prior_logits.tolist(), strict=True))
                out["loss_prior"].append(3.0 * (w if spec.adaptive else 1.0) * pull)
            if spec.adaptive:
                out["loss_prior_weight"].append(5.0 * (y - at * signal) ** 2)
                if td_error == "original":
                    out["loss_prior_critic"].append(7.0 * (v - target) ** 2)
    return {key: torch.tensor(value) for key, value in out.items() if value}


@pytest.mark.parametrize("weight_target", ["td", "advantage"])
@pytest.mark.parametrize("td_error", ["original", "shaped"])
@pytest.mark.parametrize("method", METHODS)
def test_losses_are_those_of_a_loop_over_steps(method, td_error, weight_target):
    spec = METHODS[method]
    options = {"td_error": td_error, "weight_target": weight_target, "bonus_coeff": 0.5}
    options |= {"aux_coeff": 3.0, "weight_coeff": 5.0, "critic_coeff": 7.0, "gamma": 0.9}
    if spec.adaptive and (
        (weight_target == "td" and spec.bonus == "none")
        or (weight_target == "advantage" and td_error == "shaped" and spec.bonus != "none")
    ):
        with pytest.raises(ValueError, match="weight_target"):
            make_loss(method, **options)
        return
    loss = make_loss(method, **options, reduction="none", functional=False)
    if not spec.adaptive:
        assert loss.prior_weight is None
        assert loss.critic_network is None
        loss.__dict__.update(prior_weight=make_weight(), critic_network=make_critic())  # for the loop only
    data = make_batch()
    expected = loop(loss, data, spec, td_error, weight_target, coeff=0.5)
    losses = loss(data)
    assert loss_names(losses) == expected.keys()
    for key, value in expected.items():
        torch.testing.assert_close(losses[key], value)


# ---------------------------------------------------------------------------------------------------------------------
# Which loss reaches which network
# ---------------------------------------------------------------------------------------------------------------------

REACHES = {
    "loss_prior": "actor_network_params",
    "loss_prior_weight": "prior_weight_params",
    "loss_prior_critic": "critic_network_params",
}


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("kind", ["categorical", "one_hot", "normal", "tanh_normal"])
@pytest.mark.parametrize("method", ["e2r", *ADAPTIVE, "kickstart"])
def test_each_loss_reaches_its_own_network_only(method, kind, functional):
    loss = make_loss(method, kind, functional=functional)
    data = make_batch(kind)
    for key in (key for key in loss.out_keys if key.startswith("loss_")):
        loss.zero_grad()
        loss(data)[key].backward()
        reached = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None and p.grad.any()}
        assert reached == {REACHES[key] if functional else REACHES[key].removesuffix("_params")}


def test_a_shared_trunk_is_left_to_the_actor():
    trunk = nn.Linear(3, 4)
    shared = TensorDictModule(trunk, ["observation"], ["hidden"])
    actor = make_actor()
    weight = TensorDictSequential(
        shared, TensorDictModule(nn.Sequential(nn.Linear(4, 1), nn.Sigmoid()), ["hidden"], ["w"])
    )
    net = TensorDictSequential(shared, TensorDictModule(nn.Linear(4, 2), ["hidden"], ["logits"]))
    student = ProbabilisticActor(net, in_keys=["logits"], distribution_class=torch.distributions.Categorical)
    loss = AE2RLoss(student, actor, weight, make_critic())
    loss(make_batch())["loss_prior_weight"].backward()
    assert trunk.weight.grad is None
    assert weight[1].module[0].weight.grad is not None
    loss(make_batch())["loss_prior"].backward()
    assert trunk.weight.grad is not None


@pytest.mark.parametrize("method", ADAPTIVE)
def test_the_shaped_critic_is_left_to_the_policy_loss(method):
    loss = make_loss(method, td_error="shaped")
    sum(value for key, value in loss(make_batch()).items() if key.startswith("loss_")).backward()
    assert "loss_prior_critic" not in loss.out_keys
    assert all(p.grad is None for p in loss.critic_network_params.parameters())


def test_teacher_never_changes():
    loss = make_loss()
    before = {name: p.clone() for name, p in loss.prior.named_parameters()}
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1, weight_decay=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        sum(value for key, value in loss(make_batch()).items() if key.startswith("loss_")).backward()
        optimizer.step()
    assert same_tensors(before, dict(loss.prior.named_parameters()))


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_the_auxiliary_loss_alone_teaches_the_best_action_of_the_teacher(kind):
    loss = make_loss("kickstart", kind)
    data = make_batch(kind, batch=(32,))
    optimizer = torch.optim.Adam(loss.actor_network_params.parameters(), lr=0.05)
    for _ in range(300):
        optimizer.zero_grad()
        loss(data)["loss_prior"].backward()
        optimizer.step()
    prior_dist = loss.prior.get_dist(data.copy())
    best = prior_dist.log_prob(prior_dist.mode)
    torch.testing.assert_close(loss(data)["prior_cross_entropy"], -best.mean(), atol=0.2, rtol=0)


@pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
def test_a_weight_of_one_is_e2r(reduction):
    actor, prior, critic, data = make_actor(), make_actor(), make_critic(), make_batch()
    e2r = AE2RLoss(actor, prior, method="e2r", reduction=reduction)
    ae2r = AE2RLoss(actor, prior, make_constant_weight(1.0), critic, reduction=reduction)
    assert torch.equal(e2r(data)["loss_prior"], ae2r(data)["loss_prior"])


@pytest.mark.parametrize("kind", ["categorical", "normal"])
def test_a_weight_of_zero_has_no_gradient(kind):
    loss = make_loss(kind=kind, prior_weight=make_constant_weight(0.0))
    loss(make_batch(kind))["loss_prior"].backward()
    assert not any(p.grad.any() for p in loss.actor_network_params.parameters())


def test_the_batch_is_left_as_it_is():
    data = make_batch()
    before = data.clone()
    make_loss()(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()
