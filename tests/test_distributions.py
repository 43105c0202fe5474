"""The cross-entropy is exact where it can be, estimated where it can't, and never estimated for discrete actions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import distributions as d
from torchrl.modules import (
    IndependentNormal,
    MaskedCategorical,
    OneHotCategorical,
    TanhNormal,
    TruncatedNormal,
)

from torchrl_priors.distributions import cross_entropy, cross_entropy_and_kl, kl_divergence

BATCH, ACTIONS = 4, 3


def loc():
    return torch.randn(BATCH, ACTIONS, dtype=torch.double)


def scale():
    return torch.rand(BATCH, ACTIONS, dtype=torch.double) + 0.5


EXACT = {
    "categorical": (lambda: d.Categorical(logits=loc()), None),
    "one_hot": (lambda: OneHotCategorical(logits=loc()), None),
    "torch_one_hot": (lambda: d.OneHotCategorical(logits=loc()), None),
    "probabilities": (lambda: d.Categorical(probs=scale()), lambda: d.Categorical(logits=loc())),
    "normal": (lambda: d.Normal(loc(), scale()), None),
    "independent": (lambda: d.Independent(d.Normal(loc(), scale()), 1), None),
    "all_dims_independent": (lambda: d.Independent(d.Normal(loc(), scale()), 2), None),
    "torchrl_normal": (lambda: IndependentNormal(loc(), scale()), lambda: d.Independent(d.Normal(loc(), scale()), 1)),
    "bernoullis": (lambda: d.Independent(d.Bernoulli(logits=loc()), 1), None),
    "categoricals": (lambda: d.Independent(d.Categorical(logits=loc()), 1), None),
    "beta": (lambda: d.Independent(d.Beta(scale() + 1, scale() + 1), 1), None),
    "multivariate_normal": (lambda: d.MultivariateNormal(loc(), torch.diag_embed(scale())), None),
}
SAMPLED = {
    "tanh_normal": lambda: TanhNormal(loc(), scale()),
    "tanh_normal_bounds": lambda: TanhNormal(
        loc(), scale(), low=torch.tensor([-2.0, 0.0, -1.0]).double(), high=torch.tensor([1.0, 3.0, 1.0]).double()
    ),
    "truncated_normal": lambda: TruncatedNormal(loc(), scale()),
}


def monte_carlo(dist, prior_dist, n=20_000):
    """Mean and standard error of -log pi0 over samples of the student, without a line of the code under test."""
    log_prob = torch.stack([-prior_dist.log_prob(dist.sample()) for _ in range(200)])
    log_prob = torch.cat([log_prob, -prior_dist.log_prob(dist.sample((n,)))])
    return log_prob.mean(0), log_prob.std(0) / math.sqrt(len(log_prob))


@pytest.mark.parametrize("case", EXACT)
def test_closed_form_is_the_mean_over_samples(case):
    make, make_prior = EXACT[case]
    dist, prior_dist = make(), (make_prior or make)()
    value = cross_entropy(dist, prior_dist)
    mean, error = monte_carlo(dist, prior_dist)
    assert value.shape == dist.batch_shape
    assert ((value - mean).abs() < 5 * error).all()


@pytest.mark.parametrize("case", EXACT)
def test_closed_form_draws_no_random_numbers(case):
    make, make_prior = EXACT[case]
    dist, prior_dist = make(), (make_prior or make)()
    before = torch.get_rng_state()
    assert torch.equal(cross_entropy(dist, prior_dist), cross_entropy(dist, prior_dist, num_samples=7))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("case", EXACT)
def test_cross_entropy_of_a_distribution_with_itself_is_its_entropy(case):
    dist = EXACT[case][0]()
    torch.testing.assert_close(cross_entropy(dist, dist), dist.entropy())
    torch.testing.assert_close(kl_divergence(dist, dist), torch.zeros_like(dist.entropy()), atol=1e-12, rtol=0)


def test_categorical_families_mix():
    logits, prior_logits = loc(), loc()
    expected = cross_entropy(d.Categorical(logits=logits), d.Categorical(logits=prior_logits))
    families = (d.Categorical, d.OneHotCategorical, OneHotCategorical)
    for family in families:
        for prior_family in families:
            value = cross_entropy(family(logits=logits), prior_family(logits=prior_logits))
            torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("case", SAMPLED)
def test_estimate_is_the_mean_over_samples(case):
    dist, prior_dist = SAMPLED[case](), SAMPLED[case]()
    value = cross_entropy(dist, prior_dist, num_samples=20_000)
    mean, error = monte_carlo(dist, prior_dist)
    assert not torch.equal(cross_entropy(dist, prior_dist, num_samples=20_000), value)
    assert ((value - mean).abs() < 7 * error).all()  # both sides are estimates
    assert torch.equal(torch.isfinite(cross_entropy(dist, prior_dist)), torch.ones(BATCH, dtype=torch.bool))


def test_gradient_of_the_estimate_is_that_of_the_integral():
    """For one squashed action the integral is a Gauss-Hermite quadrature over the Gaussian before the tanh."""
    mean, std = torch.tensor([[0.3]]).double().requires_grad_(), torch.tensor([[0.6]]).double().requires_grad_()
    prior_dist = TanhNormal(torch.tensor([[-0.4]]).double(), torch.tensor([[0.8]]).double())
    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.hermite_e.hermegauss(60))
    action = torch.tanh(mean + std * nodes.unsqueeze(-1)).unsqueeze(-1)
    integral = -(weights * prior_dist.log_prob(action).flatten()).sum() / math.sqrt(2 * math.pi)
    expected = torch.autograd.grad(integral, [mean, std])

    value = cross_entropy(TanhNormal(mean, std), prior_dist, num_samples=100_000).sum()
    torch.testing.assert_close(value, integral, atol=1e-2, rtol=0)
    for gradient, reference in zip(torch.autograd.grad(value, [mean, std]), expected, strict=True):
        torch.testing.assert_close(gradient, reference, atol=2e-2, rtol=0)


def test_estimate_near_the_bounds_of_a_squashed_action_is_finite():
    mean = torch.full((1, 2), 12.0, requires_grad=True)
    dist, prior_dist = TanhNormal(mean, torch.ones(1, 2)), TanhNormal(-torch.ones(1, 2), torch.ones(1, 2))
    value = cross_entropy(dist, prior_dist, num_samples=100)
    value.sum().backward()
    assert torch.isfinite(value).all()
    assert torch.isfinite(mean.grad).all()


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda logits: d.Categorical(logits=logits), ["logits"]),
        (lambda loc, scale: IndependentNormal(loc, scale), ["loc", "scale"]),
        (lambda loc, scale: TanhNormal(loc, scale), ["loc", "scale"]),
    ],
)
def test_gradient_reaches_every_parameter_of_the_student(make, names):
    parameters = [(loc() if name != "scale" else scale()).requires_grad_() for name in names]
    prior_dist = make(*(loc() if name != "scale" else scale() for name in names))
    gradients = torch.autograd.grad(cross_entropy(make(*parameters), prior_dist).sum(), parameters)
    assert all((gradient != 0).all() for gradient in gradients)


def test_an_action_that_both_forbid_costs_nothing():
    mask = torch.tensor([True, False, True])
    logits = torch.randn(2, 3, requires_grad=True)
    prior_logits = torch.randn(2, 3)
    dist = MaskedCategorical(logits=logits, mask=mask.expand(2, 3))
    prior_dist = MaskedCategorical(logits=prior_logits, mask=mask.expand(2, 3))
    kept, prior_kept = (d.Categorical(logits=x[:, mask]) for x in (logits, prior_logits))
    value = cross_entropy(dist, prior_dist)
    torch.testing.assert_close(value, cross_entropy(kept, prior_kept))
    torch.testing.assert_close(kl_divergence(dist, prior_dist), d.kl_divergence(kept, prior_kept))
    value.sum().backward()
    assert torch.isfinite(logits.grad).all()


def test_an_action_that_only_the_prior_forbids_costs_everything():
    dist = d.Categorical(logits=torch.zeros(3))
    prior_dist = d.Categorical(logits=torch.tensor([0.0, 0.0, -torch.inf]))
    assert cross_entropy(dist, prior_dist) == torch.inf


def test_discrete_actions_without_a_closed_form_are_never_sampled():
    with pytest.raises(NotImplementedError, match="Binomial"):
        cross_entropy(d.Binomial(3, torch.full((2,), 0.5)), d.Poisson(torch.ones(2)), num_samples=100)


@pytest.mark.parametrize(
    ("dist", "prior_dist"),
    [
        (d.Categorical(torch.ones(2, 3)), d.Categorical(torch.ones(2, 4))),
        (
            IndependentNormal(torch.zeros(2, 3), torch.ones(2, 3)),
            IndependentNormal(torch.zeros(2, 1), torch.ones(2, 1)),
        ),
        (IndependentNormal(torch.zeros(2, 3), torch.ones(2, 3)), d.Normal(torch.zeros(2, 3), torch.ones(2, 3))),
        (d.Categorical(torch.ones(2, 3)), IndependentNormal(torch.zeros(2, 3), torch.ones(2, 3))),
    ],
)
def test_different_actions_are_refused(dist, prior_dist):
    with pytest.raises(ValueError, match="same actions"):
        cross_entropy(dist, prior_dist)


def test_a_cross_entropy_of_no_samples_is_refused():
    dist = d.Categorical(torch.ones(2))
    with pytest.raises(ValueError, match="num_samples"):
        cross_entropy(dist, dist, num_samples=0)


def test_the_divergence_of_a_mixture_is_the_mean_over_its_samples():
    parts = d.Independent(d.Normal(torch.tensor([[-1.0], [1.0]]), torch.full((2, 1), 0.3)), 1)
    mixture = d.MixtureSameFamily(d.Categorical(torch.tensor([0.4, 0.6])), parts)
    prior = IndependentNormal(torch.zeros(1), torch.ones(1))
    torch.manual_seed(0)
    exact, kl = cross_entropy_and_kl(mixture, prior, num_samples=20_000)
    points = torch.linspace(-5, 5, 20_001).unsqueeze(-1)
    density = mixture.log_prob(points).exp()
    expected = (density * (density.log() - prior.log_prob(points))).sum() * (points[1] - points[0])
    torch.testing.assert_close(kl, expected.squeeze(), atol=0.02, rtol=0)
    assert exact > kl
