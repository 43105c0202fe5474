"""Claims about priors that are wrong on purpose."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule
from torch import distributions as d
from torchrl.modules import IndependentNormal, TanhNormal

from torchrl_priors.degradation import RandomDegradation, StructuralDegradation
from torchrl_priors.priors import ActionPrior, BoltzmannPrior, ModulePrior, UniformPrior
from torchrl_priors.transforms import PriorLogProb

STATES, ACTIONS = 6, 3


@pytest.fixture
def prior() -> BoltzmannPrior:
    return BoltzmannPrior(torch.randn(STATES, ACTIONS))


def visits(*batch: int) -> TensorDict:
    return TensorDict(state=torch.randint(STATES, batch), action=torch.randint(ACTIONS, batch), batch_size=batch)


def gaussian() -> ActionPrior:
    return ActionPrior(
        ProbabilisticTensorDictModule(
            {"loc": "loc0", "scale": "scale0"}, ["action"], distribution_class=IndependentNormal
        )
    )


def assert_advice(
    mixed: ActionPrior, good: ActionPrior, bad: ActionPrior, batch: TensorDict, mask: torch.Tensor
) -> None:
    expected = torch.where(mask, bad.log_prob(batch), good.log_prob(batch))
    torch.testing.assert_close(mixed.log_prob(batch), expected)


class TestStructuralDegradation:
    MASK = torch.tensor([False, True, False, True, True, False])

    @pytest.mark.parametrize("how", ["table", "key", "key_with_trailing_dimension", "function", "module"])
    def test_adversary_advises_on_degraded_states_only(self, prior: BoltzmannPrior, how: str) -> None:
        batch = visits(2, 20)
        mask = self.MASK[batch["state"]]
        assert mask.any()
        assert not mask.all()
        degraded = {
            "table": self.MASK,
            "key": ("degraded", "mask"),
            "key_with_trailing_dimension": ("degraded", "mask"),
            "function": lambda td: self.MASK[td["state"]],
            "module": TensorDictModule(lambda state: self.MASK[state], in_keys=["state"], out_keys=["mask"]),
        }[how]
        if how.startswith("key"):
            batch["degraded"] = TensorDict(mask=mask.unsqueeze(-1) if "trailing" in how else mask, batch_size=[2, 20])
        keys = set(batch.keys(True, True))
        assert_advice(StructuralDegradation(prior, degraded), prior, prior.adversary(), batch, mask)
        assert set(batch.keys(True, True)) == keys

    def test_each_world_has_a_mask_of_its_own(self) -> None:
        prior = BoltzmannPrior(torch.randn(2, STATES, ACTIONS))
        table = torch.rand(2, STATES) < 0.5
        batch = visits(2, 9)
        mask = torch.stack([table[world, batch["state"][world]] for world in range(2)])
        assert_advice(StructuralDegradation(prior, table), prior, prior.adversary(), batch, mask)

    def test_degraded_continuous_advice_has_the_negated_mean(self) -> None:
        batch = TensorDict(
            loc0=torch.randn(4, 2),
            scale0=torch.rand(4, 2) + 0.1,
            bad=torch.tensor([True, False, True, False]),
            batch_size=[4],
        )
        dist = StructuralDegradation(gaussian(), "bad").get_dist(batch)
        sign = torch.where(batch["bad"], -1.0, 1.0).unsqueeze(-1)
        torch.testing.assert_close(dist.base_dist.loc, sign * batch["loc0"])
        torch.testing.assert_close(dist.base_dist.scale, batch["scale0"])

    def test_scalar_parameters_are_degraded(self) -> None:
        module = ProbabilisticTensorDictModule(
            {"loc": "loc0", "scale": "scale0"}, ["action"], distribution_class=d.Normal
        )
        batch = TensorDict(
            loc0=torch.ones(2), scale0=torch.ones(2), bad=torch.tensor([[True], [False]]), batch_size=[2]
        )
        assert StructuralDegradation(ActionPrior(module), "bad").get_dist(batch).loc.tolist() == [-1.0, 1.0]

    def test_bad_advice_is_that_of_another_adversary(self, prior: BoltzmannPrior) -> None:
        batch = visits(30)
        adversary = UniformPrior(ACTIONS)
        mixed = StructuralDegradation(prior, self.MASK, adversary)
        assert_advice(mixed, prior, adversary, batch, self.MASK[batch["state"]])

    def test_adversary_of_a_degraded_prior_is_good_where_it_is_bad(self, prior: BoltzmannPrior) -> None:
        batch = visits(30)
        mixed = StructuralDegradation(prior, self.MASK)
        assert_advice(mixed.adversary(), prior, prior.adversary(), batch, ~self.MASK[batch["state"]])

    def test_a_structural_degradation_reads_what_its_mask_needs(self, prior: BoltzmannPrior) -> None:
        assert StructuralDegradation(prior, self.MASK).in_keys == ["state"]
        assert StructuralDegradation(prior, self.MASK, state_key="cell").in_keys == ["state", "cell"]
        assert StructuralDegradation(prior, "mask").in_keys == ["state", "mask"]

    def test_bad_masks_are_refused(self, prior: BoltzmannPrior) -> None:
        with pytest.raises(ValueError, match="bool"):
            StructuralDegradation(prior, self.MASK.long())
        with pytest.raises(ValueError, match="bool"):
            StructuralDegradation(prior, lambda td: td["state"]).get_dist(visits(3))
        with pytest.raises(KeyError, match="nowhere"):
            StructuralDegradation(prior, "nowhere").get_dist(visits(3))
        with pytest.raises(ValueError, match="parameters"):
            StructuralDegradation(prior, self.MASK, gaussian())
        squashed, plain = (
            ModulePrior(torch.nn.Linear(3, 2), "mean", std=0.1, distribution_class=kind)
            for kind in (TanhNormal, IndependentNormal)
        )
        with pytest.raises(ValueError, match=r"IndependentNormal would be read as the prior's TanhNormal"):
            StructuralDegradation(squashed, "bad", plain)


class TestRandomDegradation:
    def test_the_draw_of_a_step_is_shared(self, prior: BoltzmannPrior) -> None:
        batch = visits(50)
        mixed = RandomDegradation(prior, 0.5)
        first = mixed.log_prob(batch)
        mask = batch["prior", "degraded"]
        assert mask.shape == (50, 1)
        assert 0 < mask.sum() < 50
        assert_advice(mixed, prior, prior.adversary(), batch, mask.squeeze(-1))
        assert torch.equal(mixed.log_prob(batch), first)
        # a loss that is given a copy, or a minibatch in another order, sees the same advice
        order = torch.randperm(50)
        assert torch.equal(mixed.log_prob(batch[order].copy()), first[order])

    def test_advice_of_distribution_and_parameters_agree(self, prior: BoltzmannPrior) -> None:
        batch = visits(50)
        mixed = RandomDegradation(prior, 0.5)
        mixed(batch)
        torch.testing.assert_close(batch["prior", "logits"].log_softmax(-1), mixed.get_dist(batch).logits)

    @pytest.mark.parametrize("p", [0.0, 1.0])
    def test_advice_is_never_bad_at_0_and_always_at_1(self, prior: BoltzmannPrior, p: float) -> None:
        batch = visits(50)
        assert_advice(RandomDegradation(prior, p), prior, prior.adversary(), batch, torch.tensor(bool(p)))

    def test_bad_advice_comes_with_frequency_p(self, prior: BoltzmannPrior) -> None:
        batch = visits(20_000)
        RandomDegradation(prior, 0.15, seed=1).draw(batch)
        assert abs(batch["prior", "degraded"].float().mean() - 0.15) < 0.01  # 4 standard deviations

    def test_same_seed_same_draws(self, prior: BoltzmannPrior) -> None:
        def draws(seed: int) -> torch.Tensor:
            mixed = RandomDegradation(prior, 0.5, seed=seed)
            torch.rand(7)  # what others draw does not matter
            batches = [visits(20), visits(30)]
            for batch in batches:
                mixed.draw(batch)
            return torch.cat([batch["prior", "degraded"] for batch in batches])

        assert torch.equal(draws(3), draws(3))
        assert not torch.equal(draws(3), draws(4))

    def test_resumed_prior_continues_its_draws(self, prior: BoltzmannPrior) -> None:
        mixed = RandomDegradation(prior, 0.5, seed=3)
        mixed.draw(visits(20))
        state = copy.deepcopy(mixed.state_dict())
        batch, resumed_batch = visits(50), visits(50)
        mixed.draw(batch)
        resumed = RandomDegradation(prior, 0.5, seed=99)
        resumed.load_state_dict(state)
        resumed.draw(resumed_batch)
        assert torch.equal(batch["prior", "degraded"], resumed_batch["prior", "degraded"])

    def test_global_generator_by_default(self, prior: BoltzmannPrior) -> None:
        mixed = RandomDegradation(prior, 0.5)
        first, second = visits(50), visits(50)
        for batch in (first, second):
            torch.manual_seed(5)
            mixed.draw(batch)
        assert torch.equal(first["prior", "degraded"], second["prior", "degraded"])
        mixed.load_state_dict(mixed.state_dict())
        assert mixed.generator is None

    def test_two_degradations_have_two_draws(self, prior: BoltzmannPrior) -> None:
        inner = RandomDegradation(prior, 0.5, draw_key="inner")
        outer = RandomDegradation(inner, 0.5)
        assert outer.draw_keys == ["inner", ("prior", "degraded")]
        batch = visits(50)
        outer.draw(batch)
        # twice negated is good again
        assert_advice(outer, prior, prior.adversary(), batch, (batch["inner"] ^ batch["prior", "degraded"]).squeeze(-1))
        with pytest.raises(ValueError, match="draw_key"):
            RandomDegradation(RandomDegradation(prior, 0.5), 0.5)

    def test_a_random_degradation_can_be_degraded_structurally(self, prior: BoltzmannPrior) -> None:
        mixed = StructuralDegradation(RandomDegradation(prior, 0.5), torch.ones(STATES, dtype=torch.bool))
        assert mixed.draw_keys == [("prior", "degraded")]
        batch = visits(50)
        mixed.draw(batch)
        assert_advice(mixed, prior, prior.adversary(), batch, ~batch["prior", "degraded"].squeeze(-1))

    def test_draws_for_steps_without_a_next_observation(self, prior: BoltzmannPrior) -> None:
        flags = {name: torch.zeros(9, 1, dtype=torch.bool) for name in ("done", "terminated")}
        batch = visits(9).update({"action": torch.zeros(9, dtype=torch.int64), "next": TensorDict(flags, [9])})
        out = PriorLogProb(RandomDegradation(prior, 0.5), boundary="zero", time_dim=0)(batch)
        assert torch.equal(out["next", "prior", "degraded"][:-1], out["prior", "degraded"][1:])

    def test_bad_settings_are_refused(self, prior: BoltzmannPrior) -> None:
        for p in (-0.1, 1.1, float("nan")):
            with pytest.raises(ValueError, match="probability"):
                RandomDegradation(prior, p)
        with pytest.raises(ValueError, match="bool"):
            RandomDegradation(prior, 0.5).draw(visits(2).set(("prior", "degraded"), torch.zeros(2, 1)))
