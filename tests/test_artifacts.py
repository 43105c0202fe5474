"""Claims about policies in files."""

from __future__ import annotations

import json
import math
import os
import pickle
import struct
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import safetensors.torch
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, MaskedOneHotCategorical, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from torchrl_priors import PriorLogProb, StructuralDegradation
from torchrl_priors.artifacts import ArtifactError, PolicyManifest, load_policy, load_prior, read_manifest, save_policy
from torchrl_priors.artifacts.format import _NO_DIGEST, _seal, pack
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import make_actor, make_critic

OBS, ACTIONS = 4, 3
SCALE = "actor.scale.state_independent_scale"


class Saved(NamedTuple):
    path: Path
    actor: ProbabilisticActor
    normalizer: RunningNorm


def trained(**kwargs: Any) -> tuple[ProbabilisticActor, RunningNorm]:
    """An actor and statistics with no value left as it starts."""
    actor = make_actor(OBS, ACTIONS, **kwargs)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.3)
    normalizer = RunningNorm(OBS)
    normalizer.update(torch.randn(50, OBS) * torch.tensor([0.1, 1.0, 10.0, 100.0]) + 3)
    return actor, normalizer


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    actor, normalizer = trained(hidden=(8, 8))
    save_policy(tmp_path / "teacher.safetensors", actor, normalizer, env_id="Hopper-v5")
    return Saved(tmp_path / "teacher.safetensors", actor, normalizer)


def raw_batch(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS) * 20, batch_size=batch)


def act(actor: ProbabilisticActor, normalizer: RunningNorm | None, batch: TensorDict, seed: int = 0) -> TensorDict:
    """What a policy does at raw observations, sampled."""
    normal = batch["observation"] if normalizer is None else normalizer(batch["observation"])
    with torch.no_grad(), torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(seed)
        return actor(TensorDict(observation_norm=normal, batch_size=batch.batch_size))


def contents(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """The tensors and the manifest of a file, to forge another."""
    return safetensors.torch.load(path.read_bytes()), asdict(read_manifest(path))


def refused(path: Path, match: str) -> None:
    """Every reader refuses the file, for one reason, and says which file."""
    for reader in (load_policy, load_prior, read_manifest):
        with pytest.raises(ArtifactError, match=match) as caught:
            reader(path)
        assert str(path) in str(caught.value)


class TestRoundTrip:
    @pytest.mark.parametrize(
        "kwargs", [{}, {"hidden": (8,)}, {"hidden": ()}, {"hidden": (5, 6, 7), "activation": "elu"}]
    )
    def test_same_actions(self, tmp_path: Path, kwargs: dict[str, Any]) -> None:
        actor, normalizer = trained(**kwargs)
        save_policy(tmp_path / "policy", actor, normalizer, env_id="Hopper-v5")
        batch = raw_batch(7)
        expected = act(actor, normalizer, batch)
        got = act(*load_policy(tmp_path / "policy")[:2], batch)
        assert set(got.keys()) == set(expected.keys())
        for key, value in expected.items():
            assert torch.equal(got[key], value), key

    def test_manifest_is_what_was_told(self, tmp_path: Path) -> None:
        told: dict[str, Any] = {
            "env_id": "Hopper-v5",
            "seed": 3,
            "frames": 1_000_000,
            "evaluation": {"mean_return": 1828.25, "episodes": 50, "stochastic": True},
            "training": {"method": "none", "lr": 3e-4, "env": {"id": "Hopper-v5", "kwargs": {}}, "note": "é ☃ 0" * 3},
        }
        actor, _ = trained(hidden=(8, 6), activation="relu")
        manifest = save_policy(tmp_path / "policy", actor, RunningNorm(OBS, eps=1e-5, clip=5.0), **told)
        assert manifest == read_manifest(tmp_path / "policy") == load_policy(tmp_path / "policy")[2]
        assert manifest == PolicyManifest(
            obs_dim=OBS,
            act_dim=ACTIONS,
            hidden=(8, 6),
            activation="relu",
            normalizer={"eps": 1e-5, "clip": 5.0},
            **told,
        )

    def test_normalizer_comes_back_whole_and_frozen(self, tmp_path: Path) -> None:
        actor, normalizer = trained()
        normalizer.clip, normalizer.eps = 0.5, 0.1
        save_policy(tmp_path / "policy", actor, normalizer, env_id="Hopper-v5")
        loaded = load_policy(tmp_path / "policy")[1]
        for name, value in normalizer.state_dict().items():
            assert torch.equal(loaded.state_dict()[name], value), name
            assert loaded.state_dict()[name].dtype is torch.float64
        observation = raw_batch(9)["observation"]
        assert torch.equal(loaded(observation), normalizer(observation))
        with pytest.raises(RuntimeError, match="frozen"):
            loaded.update(observation)

    def test_policy_of_raw_observations_needs_no_statistics(self, tmp_path: Path) -> None:
        actor, _ = trained()
        save_policy(tmp_path / "policy", actor, None, env_id="Hopper-v5")
        loaded, normalizer, manifest = load_policy(tmp_path / "policy")
        assert normalizer is None
        assert manifest.normalizer is None
        batch = raw_batch(7)
        assert torch.equal(act(loaded, None, batch)["action"], act(actor, None, batch)["action"])
        assert torch.equal(load_prior(tmp_path / "policy").get_dist(batch).mean, act(actor, None, batch)["loc"])

    def test_loaded_policy_goes_on_learning(self, saved: Saved) -> None:
        actor, normalizer, _ = load_policy(saved.path)
        before = [parameter.clone() for parameter in actor.parameters()]
        optimizer = torch.optim.SGD(actor.parameters(), lr=0.1)
        dist = actor.get_dist(TensorDict(observation_norm=normalizer(raw_batch(7)["observation"]), batch_size=[7]))
        dist.log_prob(torch.ones(7, ACTIONS)).sum().backward()
        optimizer.step()
        for parameter, old in zip(actor.parameters(), before, strict=True):
            assert not torch.equal(parameter, old)

    def test_saving_copies(self, saved: Saved) -> None:
        expected = act(*load_policy(saved.path)[:2], raw_batch(3).zero_())
        with torch.no_grad():
            next(saved.actor.parameters()).add_(1)
        saved.normalizer.update(torch.ones(5, OBS))
        assert torch.equal(act(*load_policy(saved.path)[:2], raw_batch(3).zero_())["action"], expected["action"])

    def test_same_policy_gives_the_same_bytes(self, saved: Saved) -> None:
        again = saved.path.with_name("again")
        actor, normalizer, _ = load_policy(saved.path, in_key="elsewhere")
        save_policy(again, actor, normalizer, env_id="Hopper-v5")
        assert again.read_bytes() == saved.path.read_bytes()

    def test_loads_on_the_device_that_is_asked_for(self, saved: Saved) -> None:
        actor, normalizer, _ = load_policy(saved.path, device="meta")
        assert normalizer is not None
        for value in (*actor.state_dict().values(), *normalizer.state_dict().values()):
            assert value.device.type == "meta"

    def test_loading_draws_no_random_number(self, saved: Saved) -> None:
        before = torch.get_rng_state()
        load_prior(saved.path)
        assert torch.equal(torch.get_rng_state(), before)

    def test_parameters_may_be_views_of_one_buffer(self, saved: Saved) -> None:
        flat = torch.nn.utils.parameters_to_vector(saved.actor.parameters()).detach().clone()
        torch.nn.utils.vector_to_parameters(flat, saved.actor.parameters())
        save_policy(saved.path.with_name("again"), saved.actor, saved.normalizer, env_id="Hopper-v5")
        assert saved.path.with_name("again").read_bytes() == saved.path.read_bytes()

    def test_manifest_may_hold_what_looks_like_an_empty_digest(self, tmp_path: Path) -> None:
        save_policy(tmp_path / "policy", *trained(), env_id="0" * 64, training={"0" * 64: "0" * 640})
        assert read_manifest(tmp_path / "policy").env_id == "0" * 64

    def test_functional_losses_leave_the_actor_fit_to_be_saved(self, saved: Saved) -> None:
        loss = ClipPPOLoss(saved.actor, make_critic(OBS), functional=True)
        assert any(parameter.requires_grad for parameter in loss.parameters())
        save_policy(saved.path.with_name("again"), saved.actor, saved.normalizer, env_id="Hopper-v5")
        assert saved.path.with_name("again").read_bytes() == saved.path.read_bytes()


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


class TestSavingRefuses:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("name", ["weight", "log_std", "mean", "var"])
    def test_what_is_not_finite(self, tmp_path: Path, name: str, value: float) -> None:
        actor, normalizer = trained()
        parameters = dict(actor.named_parameters())
        targets = {
            "weight": next(parameter for key, parameter in parameters.items() if key.endswith("2.weight")),
            "log_std": next(parameter for key, parameter in parameters.items() if "scale" in key),
            "mean": normalizer.mean,
            "var": normalizer.var,
        }
        targets[name].data.view(-1)[-1] = value
        with pytest.raises(ValueError, match=r"can't be saved: .* not finite"):
            save_policy(tmp_path / "policy", actor, normalizer, env_id="Hopper-v5")
        assert not list(tmp_path.iterdir())

    def test_statistics_of_another_shape(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"normalizer\.mean must be"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), RunningNorm(OBS + 1), env_id="Hopper-v5")

    def test_statistics_that_are_no_running_norm(self, tmp_path: Path) -> None:
        with pytest.raises(TypeError, match="RunningNorm, got BatchNorm1d"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), nn.BatchNorm1d(OBS), env_id="Hopper-v5")

    def test_another_precision(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"must be torch\.float32"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS).double(), None, env_id="Hopper-v5")

    @pytest.mark.parametrize("env_id", ["", None, 3])
    def test_a_missing_environment(self, tmp_path: Path, env_id: Any) -> None:
        with pytest.raises(ValueError, match="name its environment"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), None, env_id=env_id)

    @pytest.mark.parametrize("told", [{"seed": -1}, {"seed": 1.5}, {"frames": True}, {"frames": "1M"}])
    def test_impossible_numbers(self, tmp_path: Path, told: dict[str, Any]) -> None:
        with pytest.raises(ValueError, match="must be an integer"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), None, env_id="Hopper-v5", **told)

    @pytest.mark.parametrize("value", [math.nan, math.inf, object(), torch.zeros(()), {1, 2}])
    @pytest.mark.parametrize("entry", ["evaluation", "training"])
    def test_what_json_cannot_hold(self, tmp_path: Path, entry: str, value: Any) -> None:
        told: dict[str, Any] = {entry: {"nested": [value]}}
        with pytest.raises(ValueError, match=r"can't be saved.*JSON"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), None, env_id="Hopper-v5", **told)
        assert not list(tmp_path.iterdir())

    def test_a_manifest_too_long_to_be_read(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="longer than"):
            save_policy(
                tmp_path / "policy", make_actor(OBS, ACTIONS), None, env_id="Hopper-v5", training={"log": "x" * 2**20}
            )

    def test_networks_that_a_file_cannot_describe(self, tmp_path: Path) -> None:
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
            with pytest.raises(TypeError, match="Only actors of torchrl_priors"):
                save_policy(tmp_path / "policy", actor, None, env_id="Hopper-v5")

    def test_a_folder_that_is_missing(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="No folder"):
            save_policy(tmp_path / "no" / "policy", make_actor(OBS, ACTIONS), None, env_id="Hopper-v5")


class TestAtomicWrite:
    @pytest.mark.parametrize("function", ["replace", "fsync"])
    def test_a_failed_write_leaves_what_was_there(
        self, saved: Saved, monkeypatch: pytest.MonkeyPatch, function: str
    ) -> None:
        before = saved.path.read_bytes()

        def fail(*args: Any) -> None:
            raise OSError("no space left")

        monkeypatch.setattr(os, function, fail)
        with pytest.raises(OSError, match="no space left"):
            save_policy(saved.path, *trained(), env_id="Walker2d-v5")
        assert saved.path.read_bytes() == before
        assert list(saved.path.parent.iterdir()) == [saved.path]

    def test_the_name_appears_with_the_whole_file(self, saved: Saved, monkeypatch: pytest.MonkeyPatch) -> None:
        seen = []
        original = os.replace

        def look(source: Path, target: Path) -> None:
            seen.append((Path(source).parent, Path(source).read_bytes(), Path(target).read_bytes()))
            original(source, target)

        before = saved.path.read_bytes()
        monkeypatch.setattr(os, "replace", look)
        save_policy(saved.path, *trained(), env_id="Walker2d-v5")
        assert seen == [(saved.path.parent, saved.path.read_bytes(), before)]
        assert read_manifest(saved.path).env_id == "Walker2d-v5"


class TestDamage:
    """Small files, so that every byte can be damaged."""

    @staticmethod
    def tiny(path: Path) -> bytes:
        save_policy(path, make_actor(2, 1, hidden=(2,)), RunningNorm(2), env_id="Hopper-v5", evaluation={"mean": 1.0})
        return path.read_bytes()

    def test_every_flipped_byte_is_refused(self, tmp_path: Path) -> None:
        data = self.tiny(tmp_path / "policy")
        assert len(data) < 2000
        for position in range(len(data)):
            for mask in (0x01, 0x20):  # another number or letter, and the other case
                damaged = bytearray(data)
                damaged[position] ^= mask
                (tmp_path / "damaged").write_bytes(damaged)
                with pytest.raises(ArtifactError):
                    read_manifest(tmp_path / "damaged")

    def test_every_truncation_is_refused(self, tmp_path: Path) -> None:
        data = self.tiny(tmp_path / "policy")
        for length in range(len(data)):
            (tmp_path / "damaged").write_bytes(data[:length])
            with pytest.raises(ArtifactError):
                read_manifest(tmp_path / "damaged")

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
    @given(st.data())
    def test_every_other_damage_is_refused(self, tmp_path: Path, data: st.DataObject) -> None:
        original = self.tiny(tmp_path / "policy")
        damaged = original
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(damaged)))
            stop = data.draw(st.integers(start, min(start + 40, len(damaged))))
            middle = data.draw(st.binary(max_size=40) | st.just(damaged[start:stop] * 2))
            damaged = damaged[:start] + middle + damaged[stop:]
        (tmp_path / "damaged").write_bytes(damaged)
        if damaged == original:
            read_manifest(tmp_path / "damaged")
        else:
            with pytest.raises(ArtifactError):
                read_manifest(tmp_path / "damaged")

    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.binary(max_size=200), st.booleans())
    def test_arbitrary_bytes_are_refused(self, tmp_path: Path, data: bytes, framed: bool) -> None:
        (tmp_path / "policy").write_bytes(struct.pack("<Q", len(data)) + data if framed else data)
        with pytest.raises(ArtifactError):
            read_manifest(tmp_path / "policy")

    def test_a_damaged_weight_is_named_as_damage(self, saved: Saved) -> None:
        data = bytearray(saved.path.read_bytes())
        data[-3] ^= 1  # still a finite number
        saved.path.write_bytes(data)
        refused(saved.path, "damaged: its content does not match its digest")


class TestForeignFiles:
    def test_a_missing_file(self, tmp_path: Path) -> None:
        for path in (tmp_path / "no", tmp_path):
            for reader in (load_policy, load_prior, read_manifest):
                with pytest.raises(FileNotFoundError, match="No policy file at"):
                    reader(path)

    @pytest.mark.parametrize("data", [b"", b"policy", b"\x80\x04", b"PK\x03\x04" + b"\0" * 100, b"{}" * 50])
    def test_no_safetensors(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "policy").write_bytes(data)
        refused(tmp_path / "policy", "not a safetensors file")

    @pytest.mark.parametrize(
        ("metadata", "match"), [(None, "with metadata"), ({"format": "pt"}, "not one of torchrl_priors.save_policy")]
    )
    def test_safetensors_of_another_program(self, tmp_path: Path, metadata: Any, match: str) -> None:
        safetensors.torch.save_file({"weight": torch.zeros(3)}, tmp_path / "policy", metadata=metadata)
        refused(tmp_path / "policy", match)

    def test_a_large_foreign_model_is_not_read(self, tmp_path: Path) -> None:
        header = json.dumps({"weight": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
        with (tmp_path / "model").open("wb") as file:
            file.write(struct.pack("<Q", len(header)) + header)
            file.truncate(2**36)  # sparse: reading it would need 64 GiB
        refused(tmp_path / "model", "with metadata")

    @pytest.mark.parametrize("about", ["1", "[]", "null", '"text"', "{", "[" * 100_000, '{"version": NaN}'])
    def test_a_manifest_of_another_kind(self, tmp_path: Path, about: str) -> None:
        safetensors.torch.save_file({"w": torch.zeros(1)}, tmp_path / "policy", {"torchrl_priors.policy": about})
        refused(tmp_path / "policy", "manifest is not")

    @pytest.mark.parametrize("version", [2, 0, "1", None, True, 1.0])
    def test_an_unknown_version(self, saved: Saved, version: Any) -> None:
        saved.path.write_bytes(pack(*contents(saved.path), version=version))
        refused(saved.path, "version")

    @pytest.mark.parametrize(
        ("entry", "value", "match"),
        [
            ("architecture", "transformer", "architecture is unknown: 'transformer'"),
            ("architecture", None, "architecture is unknown"),
            ("activation", "sin", "activation is unknown: 'sin'"),
            ("activation", ["tanh"], "activation is unknown"),
            ("env_id", "", "name its environment"),
            ("env_id", 1, "name its environment"),
            ("obs_dim", 0, "obs_dim must be a positive integer"),
            ("obs_dim", 4.0, "obs_dim must be a positive integer"),
            ("act_dim", True, "act_dim must be a positive integer"),
            ("hidden", 8, "positive sizes"),
            ("hidden", [8, -8], "positive sizes"),
            ("hidden", [8, "8"], "positive sizes"),
            ("normalizer", True, "positive eps and clip"),
            ("normalizer", {}, "positive eps and clip"),
            ("normalizer", {"eps": 1e-8, "clip": -1}, "positive eps and clip"),
            ("normalizer", {"eps": "0", "clip": 10}, "positive eps and clip"),
            ("seed", "0", "seed must be an integer"),
            ("evaluation", [], "evaluation must be an object"),
            ("training", None, "training must be an object"),
            # well formed, but not what the tensors are
            ("obs_dim", 5, "must be torch.float32 of shape"),
            ("act_dim", 2**60, "must be torch.float32 of shape"),
            ("hidden", [8], "missing or unexpected: actor"),
            ("hidden", [2**60, 2**60], "must be torch.float32 of shape"),
            ("normalizer", None, "missing or unexpected: normalizer"),
        ],
    )
    def test_an_impossible_manifest(self, saved: Saved, entry: str, value: Any, match: str) -> None:
        tensors, manifest = contents(saved.path)
        saved.path.write_bytes(pack(tensors, {**manifest, entry: value}))
        refused(saved.path, match)

    def test_a_manifest_with_other_entries(self, saved: Saved) -> None:
        tensors, manifest = contents(saved.path)
        for other in ({**manifest, "code": "print()"}, {k: v for k, v in manifest.items() if k != "hidden"}, None):
            saved.path.write_bytes(pack(tensors, other))  # type: ignore[arg-type]
            refused(saved.path, "must have the entries")

    @pytest.mark.parametrize(
        ("changes", "match"),
        [
            ({SCALE: None}, f"missing or unexpected: {SCALE}"),
            ({"actor.mean.9.weight": torch.zeros(2)}, "missing or unexpected: actor.mean.9.weight"),
            ({SCALE: torch.zeros(ACTIONS + 1)}, r"must be torch.float32 of shape \(3,\)"),
            ({SCALE: torch.zeros(ACTIONS, dtype=torch.float64)}, "got torch.float64"),
            ({SCALE: torch.zeros(ACTIONS, dtype=torch.bfloat16)}, "got torch.bfloat16"),
            ({SCALE: torch.zeros(0)}, "shape"),
            ({SCALE: torch.full((ACTIONS,), math.nan)}, "not finite"),
            ({"actor.mean.0.bias": torch.full((8,), -math.inf)}, "not finite"),
            ({"normalizer.mean": torch.full((OBS,), math.nan).double()}, "not finite"),
            ({"normalizer.mean": torch.zeros(OBS)}, "must be torch.float64"),
            ({"normalizer.var": -torch.ones(OBS).double()}, "negative variance"),
            ({"normalizer.count": torch.tensor(-1.0).double()}, "negative variance or count"),
        ],
    )
    def test_impossible_tensors(self, saved: Saved, changes: dict[str, Any], match: str) -> None:
        tensors, manifest = contents(saved.path)
        tensors = {name: value for name, value in (tensors | changes).items() if value is not None}
        saved.path.write_bytes(pack(tensors, manifest))
        refused(saved.path, match)

    @pytest.mark.parametrize("dtype", ["F4", "F8_E8M0", "C64", "BOOL", "U16", "object", ""])
    @pytest.mark.parametrize("shape", [[ACTIONS], [-ACTIONS], [0], [2**62, 2], ["3"]])
    @pytest.mark.parametrize("offsets", [(0, 12), (12, 0), (0, 2**62), (4, 16), (-12, 0)])
    def test_an_impossible_header(self, saved: Saved, dtype: str, shape: list[Any], offsets: tuple[int, int]) -> None:
        data = saved.path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        about = json.loads(header["__metadata__"]["torchrl_priors.policy"])
        header["__metadata__"]["torchrl_priors.policy"] = json.dumps({**about, "sha256": _NO_DIGEST})
        header[SCALE] = {"dtype": dtype, "shape": shape, "data_offsets": offsets}
        forged = json.dumps(header).encode()
        saved.path.write_bytes(_seal(struct.pack("<Q", len(forged)) + forged + data[8 + size :]))
        refused(saved.path, "its tensors can't be read|actor")


class TestNothingIsUnpickled:
    class Bomb:
        def __reduce__(self) -> Any:
            return Path.touch, (Path("unpickled"),)

    def test_pickled_files_are_refused_unread(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "plain.pkl").write_bytes(pickle.dumps(self.Bomb()))
        torch.save(self.Bomb(), tmp_path / "torch.pt")
        for name in ("plain.pkl", "torch.pt"):
            refused(tmp_path / name, "not a safetensors file")
        assert not (tmp_path / "unpickled").exists()

    def test_reading_uses_no_pickle(self, saved: Saved, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*args: Any, **kwargs: Any) -> None:
            raise AssertionError("pickle was used")

        for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
            monkeypatch.setattr(module, name, fail)
        load_policy(saved.path)
        load_prior(saved.path)


class TestWithoutSafetensors:
    def test_the_package_imports_and_says_what_to_install(self, saved: Saved) -> None:
        code = (
            "import sys; sys.modules['safetensors'] = None\n"
            "import torchrl_priors, torchrl_priors.artifacts as artifacts\n"
            f"try: artifacts.load_prior({str(saved.path)!r})\n"
            "except ImportError as error: print(error)"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert "pip install 'torchrl-priors[artifacts]'" in done.stdout

    def test_saving_says_what_to_install(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "safetensors", None)
        monkeypatch.setitem(sys.modules, "safetensors.torch", None)
        with pytest.raises(ImportError, match=r"torchrl-priors\[artifacts\]"):
            save_policy(tmp_path / "policy", make_actor(OBS, ACTIONS), None, env_id="Hopper-v5")
        assert not list(tmp_path.iterdir())


def test_manifests_are_values() -> None:
    manifest = PolicyManifest(env_id="Hopper-v5", obs_dim=11, act_dim=3, hidden=(64, 64), activation="tanh")
    assert manifest == replace(manifest)
    with pytest.raises(AttributeError):
        manifest.seed = 1  # type: ignore[misc]
