"""Claims about relatives of Stable-Baselines3's usual models: other algorithms, other releases, other options."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from sb3_cases import MODELS, PPO, Saved, VecFrameStack, batch_of, observations, renamed, rewrite
from sb3_corpus import Stands
from torch import nn

from torchrl_priors.artifacts import ArtifactError, load_sb3_prior
from torchrl_priors.artifacts.sb3_files import read_vecnormalize


class TestRelatives:
    """Files of algorithms and releases that are not installed, written by hand."""

    def test_tqc_and_trpo_have_the_actors_of_sac_and_ppo(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        for name, module in (("sac", "tqc"), ("ppo", "trpo")):
            path = rewrite(
                saved(name).path, tmp_path / f"{module}.zip", data=of_module(f"sb3_contrib.{module}.policies")
            )
            batch = batch_of(observations(MODELS[name], 20))
            for std in (None, 0.1):
                found, expected = (load_sb3_prior(file, std=std).get_params(batch) for file in (path, saved(name).path))
                assert all(torch.equal(found[key], expected[key]) for key in expected)

    def test_qr_dqn_has_the_mean_of_its_quantiles(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        weight, bias = torch.randn(6 * 4, 8), torch.randn(6 * 4)
        last = {"quantile_net.quantile_net.4.weight": weight, "quantile_net.quantile_net.4.bias": bias}
        path = rewrite(
            saved("dqn").path,
            tmp_path / "model.zip",
            data=of_module("sb3_contrib.qrdqn.policies"),
            weights=lambda w: {**renamed(w, "q_net", "quantile_net"), **last},
        )
        raw = observations(MODELS["dqn"], 20)
        with torch.no_grad():
            hidden = saved("dqn").model.policy.q_net.q_net[:-1](torch.as_tensor(raw).float())
            values = nn.functional.linear(hidden, weight, bias).view(-1, 6, 4).mean(1)
        prior = load_sb3_prior(path, temperature=2.0)
        torch.testing.assert_close(prior.get_dist(batch_of(raw)).probs, (values / 2).softmax(-1))
        broken = rewrite(path, tmp_path / "broken.zip", weights=lambda w: {**w, **{k: v[1:] for k, v in last.items()}})
        with pytest.raises(ArtifactError, match=r"over \(23,\) actions, and its action space has 4"):
            load_sb3_prior(broken, temperature=2.0)

    @pytest.mark.parametrize("name", ["a2c", "ppo_image"])
    def test_weights_of_before_pytorch_1_6(self, saved: Callable[[str], Saved], tmp_path: Path, name: str) -> None:
        def strided(weights: dict[str, Any]) -> dict[str, Any]:
            """Views of one memory that do not begin where it does."""
            first, bias = weights["action_net.weight"], weights["action_net.bias"]
            memory = torch.cat([bias, first.t().flatten()])
            weights["action_net.bias"] = memory[: len(bias)]
            weights["action_net.weight"] = memory[len(bias) :].view(*first.t().shape).t()
            return weights

        for change in (lambda weights: weights, strided):
            path = rewrite(saved(name).path, tmp_path / "model.zip", weights=change, legacy=True)
            batch = batch_of(observations(MODELS[name], 20))
            found, expected = (load_sb3_prior(file) for file in (path, saved(name).path))
            for key, value in expected.state_dict().items():
                assert torch.equal(found.state_dict()[key], value)
            torch.testing.assert_close(found.get_params(batch), expected.get_params(batch))

    def test_a_stack_of_normalised_frames_is_named(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        env = VecFrameStack(saved("ppo").env, 4)
        PPO("MlpPolicy", env, device="cpu", n_steps=8, batch_size=8).save(tmp_path / "model.zip")
        with pytest.raises(ArtifactError, match=r"reads \(12,\).* VecFrameStack over VecNormalize.* CallablePrior"):
            load_sb3_prior(tmp_path / "model.zip", vecnormalize=saved("ppo").vecnormalize)

    def test_stable_baselines_2_is_named(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        with zipfile.ZipFile(tmp_path / "zipped.zip", "w") as archive:
            for name in ("data", "parameters", "parameter_list"):
                archive.writestr(name, "{}")
        (tmp_path / "pickled.pkl").write_bytes(Stands("stable_baselines.common.policies.MlpPolicy", {}).dump())
        for name in ("zipped.zip", "pickled.pkl"):
            with pytest.raises(ArtifactError, match=rf"{name} .* of Stable-Baselines 2, .* CallablePrior"):
                load_sb3_prior(tmp_path / name)
        name = "stable_baselines.common.vec_env.vec_normalize.VecNormalize"
        (tmp_path / "vec.pkl").write_bytes(Stands(name, {}).dump())
        with pytest.raises(ArtifactError, match=r"vec\.pkl .* of Stable-Baselines 2"):
            read_vecnormalize(tmp_path / "vec.pkl")

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"policy_kwargs": {"clip_mean": "2"}}, "clip_mean must be a number"),
            ({"policy_kwargs": {"clip_mean": float("inf")}}, "clip_mean must be a number"),
            ({"policy_kwargs": {"clip_mean": 0}}, "lacks actor.mu.weight"),
        ],
    )
    def test_damaged_state_dependent_noise(
        self, saved: Callable[[str], Saved], tmp_path: Path, change: dict[str, Any], match: str
    ) -> None:
        path = rewrite(saved("sac_sde").path, tmp_path / "model.zip", data=lambda data: {**data, **change})
        with pytest.raises(ArtifactError, match=match):
            load_sb3_prior(path, std=0.1)

    def test_weights_and_actions_of_different_kinds(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        for name, other in (("dqn", "sac"), ("sac", "dqn")):
            with zipfile.ZipFile(saved(other).path) as archive:
                space = json.loads(archive.read("data"))["action_space"]
            path = rewrite(
                saved(name).path, tmp_path / "model.zip", data=lambda data, space=space: {**data, "action_space": space}
            )
            with pytest.raises(ArtifactError, match="its weights are not of actions of a"):
                load_sb3_prior(path)


def of_module(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda data: {**data, "policy_class": {**data["policy_class"], "__module__": name}}
