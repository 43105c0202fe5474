"""Claims about soft action priors."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import distributions as d
from torch import nn
from torchrl.modules import (
    Delta,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
)

from torchrl_priors.priors import ActionPrior

OBS, ACTIONS = 3, 4


def normal_actor(distribution_class: type = IndependentNormal, out: int = ACTIONS) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(OBS, 8), nn.Dropout(0.5), nn.Linear(8, 2 * out), NormalParamExtractor())
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=distribution_class, return_log_prob=True
    )


def discrete_actor(distribution_class: type = d.Categorical, out: int = ACTIONS) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(OBS, 8), nn.BatchNorm1d(8), nn.Linear(8, out))
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["logits"])
    return ProbabilisticActor(module, in_keys=["logits"], distribution_class=distribution_class, return_log_prob=True)


ACTORS = {
    "categorical": lambda: discrete_actor(d.Categorical),
    "one_hot": lambda: discrete_actor(OneHotCategorical),
    "torch_one_hot": lambda: discrete_actor(d.OneHotCategorical),
    "normal": lambda: normal_actor(IndependentNormal),
    "factorised_normal": lambda: normal_actor(d.Normal),
    "tanh_normal": lambda: normal_actor(TanhNormal),
}


def observations(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS), batch_size=batch)


def exact_log_prob(dist: d.Distribution, action: torch.Tensor, ndim: int) -> torch.Tensor:
    log_prob = dist.log_prob(action)
    return log_prob.sum(-1) if log_prob.ndim > ndim else log_prob


@pytest.fixture(params=ACTORS)
def actor(request: pytest.FixtureRequest) -> ProbabilisticActor:
    return ACTORS[request.param]().eval()


class TestActionPrior:
    def test_log_prob_is_that_of_the_policy(self, actor: ProbabilisticActor) -> None:
        batch = actor(observations(5))
        expected = exact_log_prob(actor.get_dist(batch.clone()), batch["action"], 1)
        log_prob = ActionPrior(actor).log_prob(batch)
        assert log_prob.shape == (5,)
        torch.testing.assert_close(log_prob, expected)

    def test_advice_differs_between_states(self, actor: ProbabilisticActor) -> None:
        batch = actor(observations(5))
        moved = batch.clone().set("observation", batch["observation"] + 1)
        prior = ActionPrior(actor)
        assert (prior.log_prob(batch) != prior.log_prob(moved)).all()

    @pytest.mark.parametrize("name", ["normal", "tanh_normal", "factorised_normal"])
    def test_batch_of_trajectories_is_scored_step_by_step(self, name: str) -> None:
        actor = ACTORS[name]().eval()
        batch = actor(observations(2, 6))
        prior = ActionPrior(actor)
        whole = prior.log_prob(batch)
        assert whole.shape == (2, 6)
        torch.testing.assert_close(whole[1, 4], prior.log_prob(batch[1, 4]))

    def test_the_advice_of_an_action_prior_never_changes(self, actor: ProbabilisticActor) -> None:
        prior = ActionPrior(actor)
        before = copy.deepcopy(prior.state_dict())
        batch = actor(observations(5)).detach()
        advice = prior.log_prob(batch)
        holder = nn.ModuleDict({"prior": prior, "student": actor}).train()
        optimizer = torch.optim.AdamW(holder.parameters(), lr=1.0, weight_decay=1.0)
        for _ in range(3):
            student = actor.get_dist(batch.clone())
            objective = -prior.log_prob(batch).mean() - exact_log_prob(student, batch["action"], 1).mean()
            optimizer.zero_grad()
            objective.backward()
            optimizer.step()
        assert not prior.training
        assert not any(module.training for module in prior.modules())
        assert not any(parameter.requires_grad for parameter in prior.parameters())
        assert all(parameter.grad is None for parameter in prior.parameters())
        assert before.keys() == prior.state_dict().keys()
        for key, value in prior.state_dict().items():
            assert torch.equal(value, before[key]), key
        assert torch.equal(prior.log_prob(batch), advice)
        # the student did learn, from a network of its own
        assert not torch.equal(exact_log_prob(actor.eval().get_dist(batch.clone()), batch["action"], 1), advice)

    def test_student_keys_are_never_overwritten(self, actor: ProbabilisticActor) -> None:
        batch = actor(observations(5))
        teacher = copy.deepcopy(actor)
        with torch.no_grad():
            for parameter in teacher.parameters():
                parameter.add_(1)
        prior = ActionPrior(teacher)
        before = batch.clone()
        prior.get_dist(batch)
        prior.log_prob(batch)
        assert set(batch.keys(True, True)) == set(before.keys(True, True))
        prior(batch)
        assert set(batch.keys(True, True)) - set(before.keys(True, True)) == set(prior.out_keys)
        for key in before.keys(True, True):
            assert torch.equal(batch[key], before[key]), key

    def test_forward_writes_the_parameters_of_get_dist(self) -> None:
        prior = ActionPrior(normal_actor(), namespace=("teachers", "first"))
        batch = observations(5)
        dist = prior.get_dist(batch)
        prior(batch)
        assert prior.out_keys == [("teachers", "first", "loc"), ("teachers", "first", "scale")]
        assert torch.equal(batch["teachers", "first", "loc"], dist.base_dist.loc)
        assert torch.equal(batch["teachers", "first", "scale"], dist.base_dist.scale)

    def test_an_action_prior_takes_tensors_by_name(self) -> None:
        prior = ActionPrior(normal_actor())
        batch = observations(5)
        loc, scale = prior(observation=batch["observation"])
        assert torch.equal(loc, prior(batch)["prior", "loc"])
        assert scale.shape == (5, ACTIONS)

    def test_adversary_negates_the_mean_and_keeps_the_scale(self) -> None:
        prior = ActionPrior(normal_actor())
        batch = observations(5)
        good, bad = prior.get_dist(batch), prior.adversary().get_dist(batch)
        assert torch.equal(bad.base_dist.loc, -good.base_dist.loc)
        assert torch.equal(bad.base_dist.scale, good.base_dist.scale)

    def test_adversary_of_a_squashed_policy_points_the_other_way(self) -> None:
        prior = ActionPrior(normal_actor(TanhNormal))
        batch = observations(5)
        torch.testing.assert_close(
            prior.adversary().get_dist(batch).deterministic_sample, -prior.get_dist(batch).deterministic_sample
        )

    @pytest.mark.parametrize("parameter", ["logits", "probs"])
    def test_adversary_inverts_the_odds_of_discrete_actions(self, parameter: str) -> None:
        probs = torch.tensor([0.1, 0.2, 0.0, 0.7])
        value = probs if parameter == "probs" else probs.log()
        module = ProbabilisticTensorDictModule({parameter: "value"}, ["action"], distribution_class=d.Categorical)
        bad = ActionPrior(module).adversary().get_dist(TensorDict(value=value.expand(2, 4), batch_size=[2])).probs[0]
        inverse = torch.tensor([10.0, 5.0, 0.0, 1 / 0.7])
        torch.testing.assert_close(bad, inverse / inverse.sum())

    def test_adversary_of_an_adversary_is_the_prior(self, actor: ProbabilisticActor) -> None:
        prior = ActionPrior(actor)
        assert prior.adversary().adversary() is prior

    def test_adversary_needs_something_to_negate(self) -> None:
        module = ProbabilisticTensorDictModule(
            ["concentration1", "concentration0"], ["action"], distribution_class=d.Beta
        )
        with pytest.raises(NotImplementedError, match="concentration0"):
            ActionPrior(module).adversary()

    def test_normaliser_of_the_teacher_comes_along(self) -> None:
        actor = normal_actor().eval()
        with_normaliser = ProbabilisticTensorDictSequential(
            TensorDictModule(lambda x: (x - 1) / 2, in_keys=["observation"], out_keys=["observation"]), *actor.module
        )
        batch = actor(observations(5))
        raw = batch["observation"].clone()
        log_prob = ActionPrior(with_normaliser).log_prob(batch)
        assert torch.equal(batch["observation"], raw)
        normalised = batch.clone().set("observation", (raw - 1) / 2)
        torch.testing.assert_close(log_prob, ActionPrior(actor).log_prob(normalised))

    def test_an_action_prior_reads_and_scores_nested_keys(self) -> None:
        net = TensorDictModule(
            nn.Linear(OBS, ACTIONS), in_keys=[("agent", "observation")], out_keys=[("agent", "logits")]
        )
        actor = ProbabilisticActor(
            net,
            in_keys={"logits": ("agent", "logits")},
            out_keys=[("agent", "action")],
            distribution_class=d.Categorical,
        )
        batch = actor(TensorDict(agent=TensorDict(observation=torch.randn(5, OBS)), batch_size=[5]))
        prior = ActionPrior(actor)
        prior.set_keys(action=("agent", "action"))
        assert prior.out_keys == [("prior", "logits")]
        torch.testing.assert_close(
            prior.log_prob(batch), actor.get_dist(batch.clone()).log_prob(batch["agent", "action"])
        )
        assert prior.adversary().action_key == ("agent", "action")

    def test_parameters_from_a_data_set_advise_without_a_network(self) -> None:
        module = ProbabilisticTensorDictModule(
            {"loc": ("teacher", "mu"), "scale": ("teacher", "sigma")}, ["action"], distribution_class=IndependentNormal
        )
        teacher = TensorDict(mu=torch.zeros(5, 2), sigma=torch.ones(5, 2), batch_size=[5])
        batch = TensorDict(teacher=teacher, action=torch.zeros(5, 2), batch_size=[5])
        expected = torch.full((5,), -torch.log(torch.tensor(2 * torch.pi)).item())
        torch.testing.assert_close(ActionPrior(module).log_prob(batch), expected)

    def test_pickle_and_copy_keep_the_advice(self, actor: ProbabilisticActor) -> None:
        prior = ActionPrior(actor)
        batch = actor(observations(5))
        for twin in (copy.deepcopy(prior), pickle.loads(pickle.dumps(prior))):
            assert torch.equal(twin.log_prob(batch), prior.log_prob(batch))

    def test_state_dict_restores_a_teacher(self) -> None:
        first, second = ActionPrior(normal_actor()), ActionPrior(normal_actor())
        batch = observations(5)
        assert not torch.equal(first(batch.clone())["prior", "loc"], second(batch.clone())["prior", "loc"])
        second.load_state_dict(first.state_dict())
        assert torch.equal(first(batch.clone())["prior", "loc"], second(batch.clone())["prior", "loc"])

    @pytest.mark.parametrize(
        ("name", "action"),
        [
            ("categorical", torch.zeros(5, ACTIONS)),
            ("categorical", torch.zeros(5, 1, dtype=torch.int64)),
            ("one_hot", torch.zeros(5, dtype=torch.int64)),
            ("one_hot", torch.zeros(5, ACTIONS + 1)),
            ("normal", torch.zeros(5, ACTIONS + 1)),
            ("normal", torch.zeros(5, 1)),
            ("factorised_normal", torch.zeros(5, 1)),
            ("tanh_normal", torch.zeros(5, 1)),
        ],
    )
    def test_another_action_space_is_refused(self, name: str, action: torch.Tensor) -> None:
        prior = ActionPrior(ACTORS[name]())
        with pytest.raises(ValueError, match=r"action space of the prior differs.*'action' is of shape \(5"):
            prior.log_prob(observations(5).set("action", action))

    def test_actions_out_of_range_are_refused(self) -> None:
        prior = ActionPrior(discrete_actor())
        with pytest.raises(ValueError, match="prior advises on 4 actions"):
            prior.log_prob(observations(5).set("action", torch.full((5,), ACTIONS)))

    def test_missing_entries_are_named(self) -> None:
        prior = ActionPrior(normal_actor())
        with pytest.raises(KeyError, match="observation"):
            prior.get_dist(TensorDict(other=torch.zeros(5), batch_size=[5]))
        with pytest.raises(KeyError, match="set_keys"):
            prior.log_prob(observations(5))
        with pytest.raises(ValueError, match="actoin"):
            prior.set_keys(actoin="action")

    def test_policies_without_a_density_are_refused(self) -> None:
        net = TensorDictModule(nn.Linear(OBS, ACTIONS), in_keys=["observation"], out_keys=["param"])
        with pytest.raises(TypeError, match="BoltzmannPrior"):
            ActionPrior(net)
        with pytest.raises(ValueError, match="deterministic"):
            ActionPrior(ProbabilisticActor(net, in_keys=["param"], distribution_class=Delta))
        composite = ProbabilisticTensorDictModule(
            ["params"],
            ["a"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={"distribution_map": {"a": d.Normal}},
        )
        with pytest.raises(NotImplementedError, match="CompositeDistribution"):
            ActionPrior(composite)
