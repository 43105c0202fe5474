"""A policy from a file as a prior: it advises what the policy does, and for the right spaces only."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from artifacts_cases import ACTIONS, OBS, Saved, act, raw_batch, save
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, Unbounded

from torchrl_priors import PriorLogProb, StructuralDegradation
from torchrl_priors.artifacts import ArtifactError, load_prior
from torchrl_priors.collectors.running_norm import RunningNorm


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

    def test_reads_raw_observations_never_the_normalised_ones_of_the_student(self, saved: Saved) -> None:
        prior = load_prior(saved.path)
        assert prior.in_keys == ["observation"]
        alone = raw_batch(6)
        beside = alone.clone().set("observation_norm", torch.full((6, OBS), math.nan))
        assert torch.equal(prior.get_dist(beside).mean, prior.get_dist(alone).mean)
        with pytest.raises(KeyError, match="observation"):
            prior.get_dist(alone.rename_key_("observation", "observation_norm"))

    def test_statistics_of_the_student_do_not_move_the_advice(self, saved: Saved) -> None:
        batch = raw_batch(6)
        prior = load_prior(saved.path)
        before = prior.get_dist(batch).mean
        for name in ("mean", "var"):
            assert getattr(saved.normalizer, name).ne(getattr(RunningNorm(OBS), name)).all()
        saved.normalizer.update(torch.randn(100, OBS) * 1000)
        assert torch.equal(prior.get_dist(batch).mean, before)
        # with other statistics the advice would differ
        assert not torch.allclose(act(saved.actor, saved.normalizer, batch)["loc"], before)

    def test_writes_under_its_namespace_only(self, saved: Saved) -> None:
        batch = raw_batch(6)
        load_prior(saved.path, namespace="teacher")(batch)
        assert set(batch.keys(True, True)) == {"observation", ("teacher", "loc"), ("teacher", "scale")}

    def test_reads_another_key(self, saved: Saved) -> None:
        batch = raw_batch(6)
        expected = load_prior(saved.path).get_dist(batch).mean
        moved = TensorDict({"agent": {"pixels": batch["observation"]}}, batch_size=[6])
        assert torch.equal(load_prior(saved.path, in_key=("agent", "pixels")).get_dist(moved).mean, expected)

    def test_float64_observations_of_a_simulator_are_read(self, saved: Saved) -> None:
        batch = raw_batch(6)
        prior = load_prior(saved.path)
        assert torch.equal(prior.get_dist(batch.to(torch.float64)).mean, prior.get_dist(batch).mean)

    def test_is_frozen(self, saved: Saved) -> None:
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
    def test_observations_of_another_shape_are_an_error(self, saved: Saved, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match=r"Hopper-v5 reads raw observations \[\*B, 4\]"):
            load_prior(saved.path).get_dist(TensorDict(observation=torch.zeros(shape)))

    def test_actions_of_another_shape_are_an_error(self, saved: Saved) -> None:
        with pytest.raises(ValueError, match="action space"):
            load_prior(saved.path).log_prob(raw_batch(6).set("action", torch.zeros(6, ACTIONS + 1)))

    def test_the_right_environment_and_spaces_are_taken(self, saved: Saved) -> None:
        for observation, action in (
            (OBS, ACTIONS),
            ((OBS,), torch.Size([ACTIONS])),
            (Unbounded((8, OBS), dtype=torch.float64), Unbounded((8, ACTIONS))),
        ):
            load_prior(saved.path, env_id="Hopper-v5", observation_spec=observation, action_spec=action)

    @pytest.mark.parametrize("env_id", ["Hopper-v4", "hopper-v5", "HalfCheetah-v5", ""])
    def test_another_environment_is_refused(self, saved: Saved, env_id: str) -> None:
        with pytest.raises(ArtifactError, match=f"a policy of Hopper-v5, and the student's environment is {env_id}"):
            load_prior(saved.path, env_id=env_id)

    @pytest.mark.parametrize("spec", [OBS + 1, (OBS, 1), (), Unbounded((8, OBS + 1)), Unbounded((OBS, 1))])
    def test_other_observations_are_refused(self, saved: Saved, spec: Any) -> None:
        with pytest.raises(ArtifactError, match=r"observations of shape \(4,\)"):
            load_prior(saved.path, observation_spec=spec)

    @pytest.mark.parametrize("spec", [ACTIONS + 1, Unbounded((8, ACTIONS - 1))])
    def test_other_actions_are_refused(self, saved: Saved, spec: Any) -> None:
        with pytest.raises(ArtifactError, match=r"actions of shape \(3,\)"):
            load_prior(saved.path, action_spec=spec)

    def test_discrete_actions_are_refused(self, saved: Saved) -> None:
        with pytest.raises(ArtifactError, match="continuous actions"):
            load_prior(saved.path, action_spec=Categorical(ACTIONS, shape=(ACTIONS,)))

    def test_a_spec_of_several_entries_is_an_error(self, saved: Saved) -> None:
        with pytest.raises(TypeError, match="observation, other"):
            load_prior(saved.path, observation_spec=Composite(observation=Unbounded(OBS), other=Unbounded(OBS)))
