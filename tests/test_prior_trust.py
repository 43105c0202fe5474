"""A prior weight that listens before it trusts."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import distributions as d

from torchrl_priors import PriorTrust, advice_evidence
from torchrl_priors.functional import categorical_log_prob_std, gaussian_log_prob_std
from torchrl_priors.objectives import AE2RLoss
from torchrl_priors.priors import ActionPrior


def gaussian(*batch: int, seed: int = 0) -> d.Independent:
    generator = torch.Generator().manual_seed(seed)
    loc, scale = torch.randn(*batch, 3, generator=generator), torch.rand(*batch, 3, generator=generator) + 0.2
    return d.Independent(d.Normal(loc, scale), 1)


def test_the_spread_of_gaussian_log_densities_is_that_of_many_samples():
    student, prior = gaussian(4), gaussian(4, seed=1)
    torch.manual_seed(0)
    samples = prior.log_prob(student.sample((400_000,)))
    exact = gaussian_log_prob_std(
        student.base_dist.loc, student.base_dist.scale, prior.base_dist.loc, prior.base_dist.scale
    )
    torch.testing.assert_close(exact, samples.std(0), rtol=0.02, atol=0)


def test_the_spread_of_categorical_log_probabilities_by_hand():
    # log pi0 is 0 with probability 1/4 and -2 with 3/4: mean -3/2, variance 1/4 * 9/4 + 3/4 * 1/4 = 3/4
    probs, log_prior = torch.tensor([0.25, 0.75]), torch.tensor([0.0, -2.0])
    assert categorical_log_prob_std(probs.log(), log_prior).item() == pytest.approx(math.sqrt(0.75))


@pytest.mark.parametrize("kind", ["gaussian", "categorical"])
def test_evidence_is_positive_on_average_exactly_where_advantage_and_advice_agree(kind):
    torch.manual_seed(0)
    if kind == "gaussian":
        student, prior = gaussian(1).expand((20_000,)), gaussian(1, seed=1).expand((20_000,))
    else:
        student = d.Categorical(logits=torch.zeros(20_000, 4))
        prior = d.Categorical(logits=torch.tensor([1.0, 0.0, -1.0, 2.0]).expand(20_000, 4))
    log_prob = prior.log_prob(student.sample()).unsqueeze(-1)
    for sign in (1, -1):
        evidence = advice_evidence(7 * sign * log_prob + 3, log_prob, student, prior)
        # the advantage is the preference itself: the correlation is 1, but for the clipping of the advantage
        assert evidence.shape == (20_000, 1)
        assert sign * evidence.mean() == pytest.approx(1.0, abs=0.1)
    assert advice_evidence(torch.randn(20_000, 1), log_prob, student, prior).mean().abs() < 0.05


def test_scales_of_reward_do_not_matter():
    student, prior = gaussian(50), gaussian(50, seed=1)
    log_prob, advantage = prior.log_prob(student.sample()).unsqueeze(-1), torch.randn(50, 1)
    evidence = advice_evidence(advantage, log_prob, student, prior)
    torch.testing.assert_close(advice_evidence(100 * advantage + 5, log_prob, student, prior), evidence)


def test_a_prior_without_preferences_is_no_evidence():
    student = d.Categorical(logits=torch.zeros(5, 4))
    evidence = advice_evidence(torch.randn(5, 1), torch.full((5, 1), -math.log(4)), student, student)
    assert evidence.abs().max() == 0


def test_unknown_distributions_are_refused():
    uniform = d.Uniform(torch.zeros(2), torch.ones(2))
    with pytest.raises(NotImplementedError, match="Uniform"):
        advice_evidence(torch.zeros(2, 1), torch.zeros(2, 1), uniform, uniform)


def listened(slope, frames: int = 6000, chunk: int = 1000, **options) -> tuple[PriorTrust, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    trust = PriorTrust(2, listen=frames, **options)
    states = torch.randn(frames, 2, generator=generator)
    evidence = slope(states) + torch.randn(frames, 1, generator=generator)
    for part, y in zip(states.split(chunk), evidence.split(chunk), strict=True):
        assert trust(TensorDict(observation=part, batch_size=[len(part)]))["prior_weight"].abs().max() == 0
        trust.update(part, y)
    return trust, states


def weight(trust: PriorTrust, states: torch.Tensor) -> torch.Tensor:
    return trust(TensorDict(observation=states, batch_size=[len(states)]))["prior_weight"]


def test_good_advice_is_trusted_after_listening_and_not_before():
    trust, states = listened(lambda states: 0.2)
    assert trust.decided
    assert weight(trust, states).min() > 0.5


def test_advice_that_is_wrong_in_half_of_the_states_is_dropped_as_a_whole():
    trust, states = listened(lambda states: 0.2 * states[:, :1].sign())
    assert 0.3 < trust.mean_trust < 0.7
    assert weight(trust, states).abs().max() == 0


def test_without_the_joint_decision_the_weight_tells_right_states_from_wrong_ones():
    trust, states = listened(lambda states: 0.2 * states[:, :1].sign(), min_trust=0.0)
    right = states[:, 0] > 0
    assert weight(trust, states[right]).mean() > 0.85 > 0.15 > weight(trust, states[~right]).mean()


def test_the_posterior_is_that_of_the_textbook_formula_on_all_evidence_at_once():
    trust, states = listened(lambda states: 0.3, frames=500, chunk=100, min_trust=0.0)
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(500, 2, generator=generator)
    evidence = (0.3 + torch.randn(500, 1, generator=generator)).double()
    phi, variance = trust._features(states).double(), evidence.var(correction=0)
    precision = torch.eye(phi.shape[1], dtype=torch.float64) / trust.prior_std**2
    for row in phi:  # one observation after the other
        precision = precision + row[:, None] * row[None] / variance
    mean = torch.linalg.solve(precision, phi.T @ evidence.squeeze(-1) / variance)
    torch.testing.assert_close(trust.mean.double(), mean, rtol=1e-4, atol=1e-6)
    spread = (phi @ torch.linalg.inv(precision) * phi).sum(-1).sqrt()
    expected = d.Normal(0.0, 1.0).cdf(phi @ mean / spread).float().unsqueeze(-1)
    torch.testing.assert_close(weight(trust, states), expected, rtol=1e-3, atol=1e-3)


def test_rollouts_of_any_shape_and_length_are_cut_at_the_end_of_listening():
    trust = PriorTrust(2, listen=100)
    trust.update(torch.ones(7, 10, 2), torch.ones(7, 10, 1))
    assert not trust.decided
    trust.update(torch.ones(7, 10, 2), torch.ones(7, 10, 1))
    assert trust.decided
    assert trust.frames == 100
    assert trust.gram[-1, -1] == 100
    assert (trust.states == 1).all()
    before = trust.gram.clone()
    trust.update(torch.ones(7, 10, 2), torch.ones(7, 10, 1))
    assert torch.equal(trust.gram, before)


def test_a_state_dict_carries_half_of_the_listening():
    generator = torch.Generator().manual_seed(0)
    states, evidence = torch.randn(200, 2, generator=generator), torch.randn(200, 1, generator=generator)
    whole, first, second = (PriorTrust(2, listen=200, min_trust=0.0) for _ in range(3))
    whole.update(states[:120], evidence[:120])
    first.update(states[:120], evidence[:120])
    second.load_state_dict(first.state_dict())
    for trust in (whole, second):
        trust.update(states[120:], evidence[120:])
    assert torch.equal(weight(whole, states), weight(second, states))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"listen": 0}, "listen must be at least 1, got 0"),
        ({"min_trust": 1.5}, "min_trust"),
        ({"prior_std": 0.0}, "prior_std"),
        ({"in_keys": ["a", "b"]}, "One entry"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PriorTrust(2, **options)


def test_the_loss_reads_the_weight_and_does_not_train_it():
    from tensordict.nn import TensorDictModule
    from torchrl.modules import ProbabilisticActor

    def actor():
        net = TensorDictModule(torch.nn.Linear(2, 3), in_keys=["observation"], out_keys=["logits"])
        return ProbabilisticActor(net, in_keys=["logits"], distribution_class=d.Categorical)

    trust, states = listened(lambda states: 0.2)
    student = actor()
    loss = AE2RLoss(student, ActionPrior(actor()), trust, method="aligned", weight_target="none")
    losses = loss(TensorDict(observation=states, batch_size=[len(states)]))
    assert [key for key in loss.out_keys if key.startswith("loss_")] == ["loss_prior"]
    assert set(losses.keys()) == set(loss.out_keys)
    losses["loss_prior"].backward()
    assert losses["prior_weight"] == pytest.approx(weight(trust, states).mean().item(), abs=1e-5)
