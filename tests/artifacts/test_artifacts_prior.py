"""A policy as a prior, from a file too: it advises what the policy does, and for the right spaces only."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from artifacts_cases import ACTIONS, OBS, Saved, act, net, raw_batch, save, trained
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
    UnboundedDiscrete,
)
from torchrl.modules import (
    IndependentNormal,
    MaskedOneHotCategorical,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
)

from torchrl_priors import (
    ActionPrior,
    ModulePrior,
    PriorLogProb,
    StructuralDegradation,
    UniformPrior,
    load_prior,
    policy_prior,
    save_prior,
)
from torchrl_priors.artifacts import ArtifactError
from torchrl_priors.collectors import RunningNorm
from torchrl_priors.networks import make_actor


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    return save(tmp_path / "teacher.safetensors")


class TestPrior:
    def test_advises_what_the_policy_does(self, saved: Saved) -> None:
        batch = raw_batch(2, 6)
        played = act(saved.actor, saved.normalizer, batch)
        batch["action"] = played["action"]
        prior = load_prior(saved.path)
        torch.testing.assert_close(prior.log_prob(batch), played["action_log_prob"])
        assert torch.equal(prior(batch)["prior", "loc"], played["loc"])
        assert torch.equal(batch["prior", "scale"], played["scale"])

    def test_a_layer_that_comes_twice_is_there_twice(self, tmp_path: Path) -> None:
        twice = nn.Tanh()
        prior = ModulePrior(nn.Sequential(nn.Linear(OBS, 4), twice, nn.Linear(4, 1), twice), "mean", std=0.1)
        save_prior(tmp_path / "prior", prior, env_id="Toy-v0")
        batch = raw_batch(6)
        assert torch.equal(load_prior(tmp_path / "prior").get_dist(batch).mean, prior.get_dist(batch).mean)

    def test_a_loaded_prior_reads_raw_observations_never_those_that_the_student_normalised(self, saved: Saved) -> None:
        prior = load_prior(saved.path)
        assert prior.in_keys == ["observation"]
        alone = raw_batch(6)
        beside = alone.clone().set("observation_norm", torch.full((6, OBS), math.nan))
        assert torch.equal(prior.get_dist(beside).mean, prior.get_dist(alone).mean)
        with pytest.raises(KeyError, match="observation"):
            prior.get_dist(alone.rename_key_("observation", "observation_norm"))

    def test_statistics_and_weights_of_the_student_do_not_move_the_advice(self) -> None:
        actor, normalizer = trained()
        normalizer.clip, normalizer.eps = 0.5, 0.1
        batch, prior = raw_batch(6), policy_prior(actor, normalizer)
        before = prior.get_dist(batch).mean
        assert torch.equal(act(actor, normalizer, batch)["loc"], before)
        for name in ("mean", "var"):
            assert getattr(normalizer, name).ne(getattr(RunningNorm(OBS), name)).all()
        normalizer.update(torch.randn(100, OBS) * 1000)
        with torch.no_grad():
            next(actor.parameters()).add_(1)
        assert torch.equal(prior.get_dist(batch).mean, before)
        assert not torch.allclose(act(actor, normalizer, batch)["loc"], before)

    def test_a_policy_of_raw_observations_needs_no_statistics(self) -> None:
        actor, batch = trained()[0], raw_batch(2, 6)
        assert torch.equal(policy_prior(actor, None).get_dist(batch).mean, act(actor, None, batch)["loc"])

    def test_a_loaded_prior_writes_under_its_namespace_only(self, saved: Saved) -> None:
        batch = raw_batch(6)
        load_prior(saved.path, namespace="teacher")(batch)
        assert set(batch.keys(True, True)) == {"observation", ("teacher", "loc"), ("teacher", "scale")}

    def test_float64_observations_of_a_simulator_are_read(self, saved: Saved) -> None:
        batch = raw_batch(6)
        for prior in (load_prior(saved.path), policy_prior(saved.actor, None)):
            assert torch.equal(prior.get_dist(batch.to(torch.float64)).mean, prior.get_dist(batch).mean)

    def test_a_loaded_prior_is_frozen(self, saved: Saved) -> None:
        prior = load_prior(saved.path).train()
        assert not prior.training
        assert list(prior.parameters())
        assert not any(parameter.requires_grad for parameter in prior.parameters())
        assert not prior.get_dist(raw_batch(6)).mean.requires_grad

    def test_degrades_and_scores_batches_like_any_prior(self, saved: Saved) -> None:
        batch = raw_batch(2, 6)
        good = load_prior(saved.path)
        prior = StructuralDegradation(good, lambda td: td["observation"][..., 1] > 0)
        sign = torch.where(batch["observation"][..., 1:2] > 0, -1.0, 1.0)
        assert torch.equal(prior.get_dist(batch).mean, sign * good.get_dist(batch).mean)
        batch["action"] = torch.randn(2, 6, ACTIONS)
        batch["next"] = raw_batch(2, 6)
        for key in ("done", "terminated"):
            batch["next", key] = torch.zeros(2, 6, 1, dtype=torch.bool)
        scored = PriorLogProb(prior, time_dim=1, boundary="zero")(batch.clone())
        torch.testing.assert_close(scored["prior_log_prob"].squeeze(-1), prior.log_prob(batch))

    @pytest.mark.parametrize("shape", [(OBS - 1,), (6, OBS + 1), (6, 1), ()])
    @pytest.mark.parametrize("normalised", [True, False])
    def test_observations_of_another_shape_are_an_error(
        self, saved: Saved, shape: tuple[int, ...], normalised: bool
    ) -> None:
        prior = policy_prior(saved.actor, saved.normalizer if normalised else None)
        with pytest.raises(ValueError, match=r"of shape \[.*, 4\], got"):
            prior.get_dist(TensorDict(observation=torch.zeros(shape)))

    def test_actions_of_another_shape_are_an_error(self, saved: Saved) -> None:
        with pytest.raises(ValueError, match="action space"):
            load_prior(saved.path).log_prob(raw_batch(6).set("action", torch.zeros(6, ACTIONS + 1)))

    def test_a_policy_prior_is_made_of_actors_of_make_actor_only(self) -> None:
        own = TensorDictModule(nn.Linear(OBS, ACTIONS), in_keys=["observation"], out_keys=["logits"])
        inner = make_actor(OBS, ACTIONS).module[0]
        normalised = TensorDictModule(nn.BatchNorm1d(OBS), in_keys=["observation"], out_keys=["observation_norm"])
        for actor in (
            ProbabilisticActor(own, in_keys=["logits"], distribution_class=MaskedOneHotCategorical),
            ProbabilisticActor(inner, in_keys=["loc", "scale"], distribution_class=TanhNormal),
            ProbabilisticActor(
                inner,
                in_keys=["loc", "scale"],
                distribution_class=IndependentNormal,
                distribution_kwargs={"tanh_loc": True},
            ),
            nn.ModuleList([normalised, make_actor(OBS, ACTIONS)]),
        ):
            with pytest.raises(TypeError, match=r"Expected an actor of torchrl_priors\.networks\.make_actor"):
                policy_prior(actor, None)

    def test_statistics_of_a_policy_prior_are_a_running_norm_of_its_observations(self) -> None:
        with pytest.raises(TypeError, match="RunningNorm, got BatchNorm1d"):
            policy_prior(make_actor(OBS, ACTIONS), nn.BatchNorm1d(OBS))  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=r"shape \(4,\), and its statistics are of shape \(5,\)"):
            policy_prior(make_actor(OBS, ACTIONS), RunningNorm(OBS + 1))


def of_actions(kind: str) -> ActionPrior:
    if kind == "gaussian":
        return policy_prior(*trained(hidden=(8,)))
    return ModulePrior(net(), "logits", distribution_class=OneHotCategorical if kind == "one_hot" else None)


FITTING: list[tuple[str, TensorSpec | tuple[int, ...] | int]] = [
    ("index", ACTIONS),
    ("index", ()),
    ("index", Categorical(ACTIONS)),
    ("index", Categorical(ACTIONS, shape=(2,))),
    ("one_hot", ACTIONS),
    ("one_hot", OneHot(ACTIONS)),
    ("one_hot", OneHot(ACTIONS, shape=(2, ACTIONS))),
    ("gaussian", ACTIONS),
    ("gaussian", (ACTIONS,)),
    ("gaussian", torch.Size([ACTIONS])),
    ("gaussian", Bounded(-1.0, 1.0, shape=(ACTIONS,))),
    ("gaussian", Unbounded((2, ACTIONS), dtype=torch.float64)),
]
OTHERS: list[tuple[str, TensorSpec | tuple[int, ...] | int]] = [
    ("index", ACTIONS + 1),
    ("index", Categorical(ACTIONS + 1)),
    ("index", OneHot(ACTIONS)),
    ("index", Binary(ACTIONS)),
    ("index", MultiCategorical([ACTIONS])),
    ("index", Bounded(0, 3, shape=(), dtype=torch.int64)),
    ("one_hot", OneHot(ACTIONS + 1)),
    ("one_hot", Categorical(ACTIONS)),
    ("one_hot", MultiOneHot([2, 1])),
    ("one_hot", Unbounded(ACTIONS)),
    ("gaussian", OneHot(ACTIONS)),
    ("gaussian", MultiOneHot([2, 1])),
    ("gaussian", Binary(ACTIONS)),
    ("gaussian", Categorical(ACTIONS)),
    ("gaussian", UnboundedDiscrete(ACTIONS)),
    ("gaussian", Unbounded(ACTIONS + 1)),
    ("gaussian", ACTIONS + 1),
    ("gaussian", Unbounded((8, ACTIONS - 1))),
    ("gaussian", Categorical(ACTIONS, shape=(ACTIONS,))),
    ("gaussian", (ACTIONS, 1)),
]


class TestSpaces:
    @pytest.mark.parametrize(("kind", "spec"), FITTING)
    @pytest.mark.parametrize("batch", [(), (2,)])
    def test_actions_that_fit_are_taken(self, tmp_path: Path, kind: str, spec: Any, batch: tuple[int, ...]) -> None:
        save_prior(tmp_path / "prior", of_actions(kind), env_id="Toy-v0")
        load_prior(tmp_path / "prior", observation_spec=Unbounded((*batch, OBS)), action_spec=spec)

    @pytest.mark.parametrize(("kind", "spec"), OTHERS)
    def test_other_actions_are_refused(self, tmp_path: Path, kind: str, spec: Any) -> None:
        save_prior(tmp_path / "prior", of_actions(kind), env_id="Toy-v0")
        with pytest.raises(ArtifactError, match="it advises on actions"):
            load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=spec)

    @pytest.mark.parametrize("spec", [OBS, (OBS,), Unbounded((8, OBS), dtype=torch.float64)])
    def test_observations_that_fit_are_taken(self, saved: Saved, spec: Any) -> None:
        load_prior(saved.path, env_id="Hopper-v5", observation_spec=spec)

    @pytest.mark.parametrize("spec", [OBS + 1, (OBS, 1), (), Unbounded((8, OBS + 1)), Unbounded((OBS, 1))])
    @pytest.mark.parametrize("name", ["normalised", "raw", "logits"])
    def test_other_observations_are_refused(self, tmp_path: Path, spec: Any, name: str) -> None:
        actor, normalizer = trained()
        kinds = {"normalised": policy_prior(actor, normalizer), "raw": policy_prior(actor, None)}
        save_prior(tmp_path / "prior", kinds.get(name, ModulePrior(net(), "logits")), env_id="Toy-v0")
        with pytest.raises(ArtifactError, match=r"prior: it can't read observations of shape \("):
            load_prior(tmp_path / "prior", observation_spec=spec)

    @pytest.mark.parametrize("env_id", ["Hopper-v4", "hopper-v5", "HalfCheetah-v5", ""])
    def test_another_environment_is_refused(self, saved: Saved, env_id: str) -> None:
        with pytest.raises(ArtifactError, match=f"a prior of Hopper-v5, and the student's environment is {env_id}"):
            load_prior(saved.path, env_id=env_id)

    def test_a_spec_of_several_entries_is_an_error(self, saved: Saved) -> None:
        with pytest.raises(TypeError, match="observation, other"):
            load_prior(saved.path, observation_spec=Composite(observation=Unbounded(OBS), other=Unbounded(OBS)))

    def test_a_prior_that_reads_nothing_is_checked_too(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", UniformPrior(ACTIONS), env_id="Toy-v0")
        load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=ACTIONS)
        with pytest.raises(ArtifactError, match="it advises on actions"):
            load_prior(tmp_path / "prior", observation_spec=OBS, action_spec=ACTIONS + 1)

    def test_actions_alone_are_not_checked_and_so_refused(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", of_actions("index"), env_id="Toy-v0")
        with pytest.raises(ValueError, match=r"action_spec=3 needs observation_spec beside it: .*prior"):
            load_prior(tmp_path / "prior", action_spec=ACTIONS)
