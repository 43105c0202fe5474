"""Claims about affordances and mixtures of priors."""

from __future__ import annotations

import math

import pytest
import torch
from teacher_cases import ACTIONS, OBS, Pair, observations
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from torchrl_priors import (
    AffordancePrior,
    BoltzmannPrior,
    MixturePrior,
    ModulePrior,
    RandomDegradation,
    StructuralDegradation,
    UniformPrior,
)
from torchrl_priors.distributions import cross_entropy


def table(seed: int = 0, states: int = 5) -> torch.Tensor:
    return torch.rand(states, ACTIONS, generator=torch.Generator().manual_seed(seed))


def states(*values: int) -> TensorDict:
    return TensorDict(state=torch.tensor(values), batch_size=[len(values)])


class TestAffordancePrior:
    def test_probabilities_of_affordances_are_those_worked_out_by_hand(self) -> None:
        prior = AffordancePrior(torch.tensor([[1.0, 3.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]]), epsilon=0.4)
        expected = torch.tensor([[0.25, 0.55, 0.1, 0.1], [0.25, 0.25, 0.25, 0.25]])
        torch.testing.assert_close(prior.get_dist(states(0, 1)).probs, expected)

    def test_masked_actions_are_unlikely_and_never_impossible(self) -> None:
        prior = AffordancePrior(torch.tensor([[True, False]]), epsilon=0.01)
        batch = states(0, 0).set("action", torch.tensor([0, 1]))
        torch.testing.assert_close(prior.log_prob(batch), torch.tensor([0.995, 0.005]).log())

    def test_table_function_network_and_module_agree(self) -> None:
        weights = table()
        net = nn.Linear(5, ACTIONS, bias=False)
        net.weight.data.copy_(weights.T)
        batch = states(3, 1)
        batch["observation"] = nn.functional.one_hot(batch["state"], 5).float()
        module = TensorDictModule(net, in_keys=["observation"], out_keys=["mask"])
        expected = AffordancePrior(weights).get_dist(batch).probs
        for source in (net, module, lambda x: x @ weights):
            torch.testing.assert_close(AffordancePrior(source).get_dist(batch).probs, expected)

    def test_bad_input_of_affordances_is_refused(self) -> None:
        with pytest.raises(ValueError, match="epsilon"):
            AffordancePrior(table(), epsilon=0.0)
        for value in (-1.0, math.nan, math.inf):
            with pytest.raises(ValueError, match="finite and not negative"):
                AffordancePrior(torch.tensor([[1.0, value]]))
            with pytest.raises(ValueError, match="finite and not negative"):
                AffordancePrior(lambda x, value=value: x * 0 + value).get_dist(observations(2))


class TestMixturePrior:
    def test_categorical_mixture_by_hand(self) -> None:
        first, second = (BoltzmannPrior(table(seed)) for seed in (0, 1))
        batch = states(0, 3, 4)
        for weights, expected in (
            (None, torch.tensor([[0.5, 0.5]] * 3)),
            ([3.0, 1.0], torch.tensor([[0.75, 0.25]] * 3)),
            (torch.eye(2)[[0, 1, 1, 0, 1]], torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])),
        ):
            probs = torch.stack([prior.get_dist(batch).probs for prior in (first, second)])
            mixed = MixturePrior([first, second], weights).get_dist(batch)
            torch.testing.assert_close(mixed.probs, torch.einsum("bk,kba->ba", expected, probs))

    def test_gaussian_mixture_by_hand(self) -> None:
        priors = [ModulePrior(Pair(), "mean_std"), ModulePrior(nn.Linear(OBS, ACTIONS), "mean", std=0.5)]
        weights = TensorDictModule(
            lambda x: torch.stack([x[..., 0].exp(), 0 * x[..., 0] + 2], -1), ["observation"], ["w"]
        )
        batch = observations(2, 6).set("action", torch.randn(2, 6, ACTIONS))
        w = weights(batch.clone())["w"]
        expected = torch.stack([prior.log_prob(batch).exp() for prior in priors], -1)
        prior = MixturePrior(priors, weights, namespace="both")
        assert prior.out_keys == [("both", "mixture_logits"), ("both", "loc"), ("both", "scale")]
        torch.testing.assert_close(prior.log_prob(batch), ((w / w.sum(-1, keepdim=True)) * expected).sum(-1).log())
        params = prior(batch)["both"]
        torch.testing.assert_close(
            prior.build_dist(dict(params.items())).log_prob(batch["action"]), prior.log_prob(batch)
        )
        student = IndependentNormal(torch.zeros(2, 6, ACTIONS), torch.ones(2, 6, ACTIONS))
        assert cross_entropy(student, prior.get_dist(batch)).isfinite().all()
        negated = prior.adversary().get_params(batch)
        assert torch.equal(negated["loc"], -params["loc"])
        assert torch.equal(negated["mixture_logits"], params["mixture_logits"])

    def test_a_gaussian_mixture_acts_as_its_heaviest_prior_does(self) -> None:
        priors = [ModulePrior(nn.Linear(OBS, ACTIONS), "mean", std=0.1) for _ in range(2)]
        weights = TensorDictModule(
            lambda x: torch.stack([x[..., 0].exp(), (-x[..., 0]).exp()], -1), ["observation"], ["w"]
        )
        batch = observations(2, 6)
        means = [prior(batch.copy())["prior", "loc"] for prior in priors]
        expected = torch.where(batch["observation"][..., :1] > 0, *means)
        torch.testing.assert_close(MixturePrior(priors, weights).policy()(batch)["action"], expected)

    def test_one_hot_and_nested_mixtures(self) -> None:
        one_hot = [BoltzmannPrior(table(seed), distribution_class=OneHotCategorical) for seed in (0, 1, 2)]
        nested = MixturePrior([MixturePrior(one_hot[:2]), one_hot[2]], [2.0, 1.0])
        flat = MixturePrior(one_hot)
        batch = states(0, 1).set("action", torch.eye(ACTIONS)[[1, 2]])
        torch.testing.assert_close(nested.log_prob(batch), flat.log_prob(batch))

    def test_draws_and_degradations_work_inside_and_around(self) -> None:
        good = BoltzmannPrior(10 * table())
        noisy = RandomDegradation(good, 0.5, seed=0)
        mixture = MixturePrior([noisy, UniformPrior(ACTIONS)])
        batch = states(*[0] * 20)
        mixture.draw(batch)
        degraded = batch["prior", "degraded"].squeeze(-1)
        assert 0 < degraded.sum() < 20
        probs = mixture.get_dist(batch).probs
        assert len({tuple(row.tolist()) for row in probs}) == 2
        around = StructuralDegradation(mixture, torch.tensor([True, False, False, False, False]))
        torch.testing.assert_close(around.get_dist(batch).logits, mixture.adversary().get_dist(batch).logits)
        with pytest.raises(ValueError, match="draw_key"):
            MixturePrior([noisy, RandomDegradation(good, 0.5)])

    def test_bad_input_of_a_mixture_is_refused(self) -> None:
        first, second, normal = BoltzmannPrior(table()), UniformPrior(3), ModulePrior(Pair(), "mean_std")
        squashed = ModulePrior(Pair(), "mean_std", distribution_class=TanhNormal)
        for error, match, make in (
            (TypeError, "Linear", lambda: MixturePrior([first, nn.Linear(2, 2)])),
            (ValueError, "at least two", lambda: MixturePrior([first])),
            (ValueError, "a weight for each", lambda: MixturePrior([first, first], [1.0])),
            (ValueError, "not negative", lambda: MixturePrior([first, first], [1.0, -1.0])),
            (ValueError, "not all 0", lambda: MixturePrior([first, first], [0.0, 0.0])),
            (NotImplementedError, "Categorical, IndependentNormal", lambda: MixturePrior([first, normal])),
            (NotImplementedError, "TanhNormal", lambda: MixturePrior([normal, squashed])),
            (
                ValueError,
                "one-hot for others",
                lambda: MixturePrior([first, BoltzmannPrior(table(), distribution_class=OneHotCategorical)]),
            ),
            (ValueError, r"some over \[4, 3\]", lambda: MixturePrior([first, second]).get_dist(states(0))),
            (
                ValueError,
                r"must be of shape \(2, 2\)",
                lambda: MixturePrior([normal, normal], lambda x: x).get_dist(observations(2)),
            ),
        ):
            with pytest.raises(error, match=match):
                make()
