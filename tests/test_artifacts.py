"""Policies in files: what comes back is what was saved, and what can't be saved is refused."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from artifacts_cases import ACTIONS, OBS, Saved, act, raw_batch, save, trained
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, MaskedOneHotCategorical, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from torchrl_priors.artifacts import PolicyManifest, load_policy, load_prior, read_manifest, save_policy
from torchrl_priors.collectors.running_norm import RunningNorm
from torchrl_priors.networks import make_actor, make_critic


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    return save(tmp_path / "teacher.safetensors")


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
