"""Priors in files: what comes back is what was saved, and what can't be saved is refused."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from artifacts_cases import ACTIONS, OBS, STORABLE, Saved, net, raw_batch, save, trained
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP
from torchrl.objectives import ClipPPOLoss

from torchrl_priors import (
    ActionPrior,
    AffordancePrior,
    CallablePrior,
    MixturePrior,
    ModulePrior,
    UniformPrior,
    load_prior,
    policy_prior,
    save_prior,
)
from torchrl_priors.artifacts import ArtifactError, PriorManifest, read_manifest
from torchrl_priors.collectors import RunningNorm
from torchrl_priors.networks import make_actor, make_critic

TEACHERS = sorted((Path(__file__).parents[2] / "results/mujoco/teachers").glob("*.safetensors"))


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    return save(tmp_path / "teacher.safetensors")


def advice(prior: ActionPrior) -> torch.Tensor:
    return prior.get_dist(raw_batch(3).zero_()).mean


class TestRoundTrip:
    @pytest.mark.parametrize("name", STORABLE)
    def test_same_advice_and_same_bytes(self, name: str, tmp_path: Path) -> None:
        prior = STORABLE[name]()
        save_prior(tmp_path / "prior", prior, env_id="Toy-v0")
        loaded = load_prior(tmp_path / "prior", namespace="other", env_id="Toy-v0")
        assert type(loaded) is type(prior)
        assert loaded.in_keys == prior.in_keys
        x = torch.randn(2, 6, OBS)
        batch = TensorDict(
            observation=x, agent=TensorDict(observation=x, batch_size=[2, 6]), state=torch.randint(5, (2, 6)),
            pixels=torch.randint(256, (2, 6, 1, 36, 36), dtype=torch.uint8), batch_size=[2, 6],
        )  # fmt: skip
        batch["action"] = prior.get_dist(batch).sample()
        assert torch.equal(loaded.log_prob(batch), prior.log_prob(batch))
        assert all(torch.equal(value, loaded.get_params(batch)[key]) for key, value in prior.get_params(batch).items())
        save_prior(tmp_path / "again", loaded, env_id="Toy-v0")
        assert (tmp_path / "again").read_bytes() == (tmp_path / "prior").read_bytes()

    def test_a_loaded_prior_is_saved_in_a_mixture(self, saved: Saved) -> None:
        mixture = MixturePrior([load_prior(saved.path), load_prior(saved.path)])
        save_prior(saved.path.with_name("mixture"), mixture, env_id="Hopper-v5")
        batch = raw_batch(7).set("action", torch.randn(7, ACTIONS))
        loaded = load_prior(saved.path.with_name("mixture"))
        assert torch.equal(loaded.log_prob(batch), mixture.log_prob(batch))
        torch.testing.assert_close(loaded.log_prob(batch), load_prior(saved.path).log_prob(batch))

    @pytest.mark.parametrize("path", TEACHERS, ids=lambda path: path.stem)
    def test_the_teachers_of_the_results_are_files_of_this_release(self, path: Path, tmp_path: Path) -> None:
        manifest = read_manifest(path)
        told = {name: getattr(manifest, name) for name in ("env_id", "seed", "frames", "evaluation", "training")}
        assert manifest.evaluation["frames"] == manifest.frames
        save_prior(tmp_path / "again", load_prior(path), **told)
        assert (tmp_path / "again").read_bytes() == path.read_bytes()

    def test_manifest_is_what_was_told(self, tmp_path: Path) -> None:
        told: dict[str, Any] = {
            "env_id": "Hopper-v5",
            "seed": 3,
            "frames": 1_000_000,
            "evaluation": {"mean_return": 1828.25, "episodes": 50, "stochastic": True},
            "training": {"method": "none", "lr": 3e-4, "env": {"id": "Hopper-v5", "kwargs": {}}, "note": "é ☃ 0" * 3},
        }
        prior = policy_prior(trained(hidden=(8, 6), activation="relu")[0], RunningNorm(OBS, eps=1e-5, clip=5.0))
        manifest = save_prior(tmp_path / "prior", prior, **told)
        assert manifest == read_manifest(tmp_path / "prior") == PriorManifest(prior=manifest.prior, **told)
        assert manifest.prior["network"]["layers"] == [
            {"layer": "running_norm", "shape": [OBS], "eps": 1e-5, "clip": 5.0},
            {"layer": "gaussian_mlp", "obs_dim": OBS, "act_dim": ACTIONS, "hidden": [8, 6], "activation": "relu"},
        ]
        assert manifest == replace(manifest)
        with pytest.raises(AttributeError):
            manifest.seed = 1  # type: ignore[misc]

    def test_a_saved_prior_does_not_follow_its_network(self, tmp_path: Path) -> None:
        network = net()
        save_prior(tmp_path / "prior", ModulePrior(network, "mean", std=1.0), env_id="Toy-v0")
        expected = advice(load_prior(tmp_path / "prior"))
        with torch.no_grad():
            network[0].weight.add_(1)
        assert torch.equal(advice(load_prior(tmp_path / "prior")), expected)

    def test_a_loaded_prior_can_read_another_key(self, saved: Saved) -> None:
        batch = raw_batch(6)
        expected = load_prior(saved.path).get_dist(batch).mean
        moved = TensorDict({"agent": {"pixels": batch["observation"]}}, batch_size=[6])
        prior = load_prior(saved.path, in_key=("agent", "pixels"))
        assert prior.in_keys == [("agent", "pixels")]
        assert torch.equal(prior.get_dist(moved).mean, expected)

    @pytest.mark.parametrize("name", ["mixture_of_policies", "table", "q_network", "affordances"])
    def test_another_key_can_be_read_by_every_part(self, name: str, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", STORABLE[name](), env_id="Toy-v0")
        assert load_prior(tmp_path / "prior", in_key="elsewhere").in_keys == ["elsewhere"]

    def test_one_key_does_not_replace_two(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", STORABLE["mixture"](), env_id="Toy-v0")
        with pytest.raises(ArtifactError, match="in_key can't replace"):
            load_prior(tmp_path / "prior", in_key="pixels")

    def test_loads_on_the_device_that_is_asked_for(self, saved: Saved) -> None:
        values = load_prior(saved.path, device="meta").state_dict().values()
        assert {value.device.type for value in values} == {"meta"}

    def test_loading_draws_no_random_number(self, saved: Saved) -> None:
        before = torch.get_rng_state()
        load_prior(saved.path)
        assert torch.equal(torch.get_rng_state(), before)

    def test_the_default_precision_does_not_matter(self, saved: Saved) -> None:
        expected, before = advice(load_prior(saved.path)), torch.get_default_dtype()
        torch.set_default_dtype(torch.float64)
        try:
            found = load_prior(saved.path).get_dist(TensorDict(observation=torch.zeros(3, OBS), batch_size=[3])).mean
        finally:
            torch.set_default_dtype(before)
        assert torch.equal(found, expected)

    def test_parameters_may_be_views_of_one_buffer(self, saved: Saved) -> None:
        flat = torch.nn.utils.parameters_to_vector(saved.actor.parameters()).detach().clone()
        torch.nn.utils.vector_to_parameters(flat, saved.actor.parameters())
        again = saved.path.with_name("again")
        save_prior(again, policy_prior(saved.actor, saved.normalizer), env_id="Hopper-v5")
        assert again.read_bytes() == saved.path.read_bytes()

    def test_functional_losses_leave_the_actor_fit_to_be_saved(self, saved: Saved) -> None:
        loss = ClipPPOLoss(saved.actor, make_critic(OBS), functional=True)
        assert any(parameter.requires_grad for parameter in loss.parameters())
        again = saved.path.with_name("again")
        save_prior(again, policy_prior(saved.actor, saved.normalizer), env_id="Hopper-v5")
        assert again.read_bytes() == saved.path.read_bytes()

    def test_manifest_may_hold_what_looks_like_an_empty_digest(self, tmp_path: Path) -> None:
        save_prior(tmp_path / "prior", UniformPrior(2), env_id="0" * 64, training={"0" * 64: "0" * 640})
        assert read_manifest(tmp_path / "prior").env_id == "0" * 64


class Own(nn.Tanh):
    """A layer that no file knows."""


class TestSavingRefuses:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("name", ["weight", "scale", "mean", "var"])
    def test_a_prior_that_is_not_finite_is_not_saved(self, tmp_path: Path, name: str, value: float) -> None:
        actor, normalizer = trained()
        parameters = {
            key: parameter for key, parameter in actor.named_parameters() if key.endswith(("2.weight", "scale"))
        }
        targets = {key.rpartition("_")[2].rpartition(".")[2]: parameter for key, parameter in parameters.items()}
        targets |= {"mean": normalizer.mean, "var": normalizer.var}
        targets[name].data.view(-1)[-1] = value
        with pytest.raises(ValueError, match=rf"can't be saved to .*prior: prior\.network\.\S*{name} is not finite"):
            save_prior(tmp_path / "prior", policy_prior(actor, normalizer), env_id="Hopper-v5")
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("told", "match"),
        [
            *(({"env_id": value}, "name its environment, got env_id=") for value in ("", None, 3)),
            *(({"seed": value}, "its seed must be null or an integer") for value in (-1, 1.5)),
            *(({"frames": value}, "its frames must be null or an integer") for value in (True, "1M")),
            *(
                ({entry: {"nested": [value]}}, "JSON")
                for entry in ("evaluation", "training")
                for value in (math.nan, math.inf, object(), torch.zeros(()), {1, 2})
            ),
            ({"training": {"log": "x" * 2**20}}, "longer than"),
        ],
    )
    def test_what_a_manifest_cannot_hold(self, tmp_path: Path, told: dict[str, Any], match: str) -> None:
        with pytest.raises(ValueError, match=f"can't be saved to .*{match}"):
            save_prior(tmp_path / "prior", UniformPrior(2), **{"env_id": "Hopper-v5", **told})
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("prior", "match"),
        [
            (lambda: CallablePrior(lambda x: x, std=1.0), "can't hold this CallablePrior"),
            (lambda: ModulePrior(Own(), "logits"), "can't hold Own"),
            (lambda: AffordancePrior(lambda x: x), "can't hold code"),
            (lambda: ModulePrior(nn.Sequential(net(), Own()), "logits"), "can't hold Own"),
            (lambda: ModulePrior(nn.Sequential(nn.ELU(0.5), net()), "logits"), "default options"),
            (lambda: ModulePrior(nn.Sequential(OrderedDict(first=net())), "logits"), "layers have no names, got first"),
            (lambda: ModulePrior(MLP(OBS, (1, 2)), "logits"), r"MLP that reshapes its output"),
            (lambda: ModulePrior(MLP(6, 2), "logits", in_keys=["a", "b"]), r"read one entry, got in_keys=\['a', 'b'\]"),
            (lambda: MixturePrior([UniformPrior(2), CallablePrior(lambda x: 0, num_actions=2)]), "CallablePrior"),
            (lambda: ModulePrior(net(), "logits").adversary(), "can't hold this NegatedPrior"),
            (lambda: policy_prior(make_actor(OBS, ACTIONS).double(), None), "in float32"),
            (lambda: net(), "got Sequential"),
            (lambda: ActionPrior(make_actor(OBS, ACTIONS)), "this ActionPrior.*policy_prior makes"),
        ],
    )
    def test_code_and_other_precisions(self, prior: Any, match: str, tmp_path: Path) -> None:
        with pytest.raises(TypeError, match=match):
            save_prior(tmp_path / "prior", prior(), env_id="Toy-v0")
        assert not list(tmp_path.iterdir())

    def test_a_prior_is_not_saved_to_a_folder_that_is_missing(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"No folder .*no to write prior in"):
            save_prior(tmp_path / "no" / "prior", UniformPrior(2), env_id="Hopper-v5")


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
            save_prior(saved.path, UniformPrior(2), env_id="Walker2d-v5")
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
        save_prior(saved.path, UniformPrior(2), env_id="Walker2d-v5")
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
            save_prior(tmp_path / "prior", UniformPrior(2), env_id="Hopper-v5")
        assert not list(tmp_path.iterdir())
