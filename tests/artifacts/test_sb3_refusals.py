"""Files of Stable-Baselines3 that are refused, by name and with the way around; nothing in them runs."""

from __future__ import annotations

import base64
import contextlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sb3_cases import (
    BOX,
    PPO,
    DummyVecEnv,
    Noise,
    Saved,
    VecNormalize,
    renamed,
    rewrite,
)
from torch import nn

from torchrl_priors.artifacts import ArtifactError, load_sb3_prior
from torchrl_priors.artifacts.sb3_files import read_vecnormalize


class MyPolicy(PPO.policy_aliases["MlpPolicy"]):
    pass


class TestRefusals:
    @pytest.mark.parametrize(
        ("env", "policy", "kwargs", "match"),
        [
            ({}, "MlpPolicy", {"use_sde": True}, r"use_sde=True\): pass std"),
            ({"actions": spaces.MultiDiscrete([2, 3])}, "MlpPolicy", {}, "actions are a MultiDiscrete space"),
            ({"actions": spaces.MultiBinary(2)}, "MlpPolicy", {}, "actions are a MultiBinary space"),
            ({"observations": spaces.Discrete(3)}, "MlpPolicy", {}, "observations are a Discrete space"),
            (
                {"observations": spaces.Dict(a=BOX)},
                "MultiInputPolicy",
                {},
                r"observations are a Dict space.* CallablePrior\(lambda a, b: model.predict\({\"a\": a",
            ),
            (
                {},
                MyPolicy,
                {},
                r"policy class is one of test_sb3_refusals, and only those of PPO, "
                r".* CallablePrior\(lambda o: model.predict",
            ),
            ({}, "MlpPolicy", {"policy_kwargs": {"activation_fn": nn.Hardtanh}}, "Hardtanh"),
        ],
    )
    def test_policies_that_cannot_be_converted(
        self, tmp_path: Path, env: dict[str, Any], policy: Any, kwargs: dict[str, Any], match: str
    ) -> None:
        PPO(policy, Noise(**env), device="cpu", n_steps=8, batch_size=8, **kwargs).save(tmp_path / "model.zip")
        with pytest.raises(ArtifactError, match=match) as caught:
            load_sb3_prior(tmp_path / "model.zip")
        assert str(tmp_path / "model.zip") in str(caught.value)

    def test_what_contradicts_the_file(self, saved: Callable[[str], Saved]) -> None:
        with pytest.raises(ValueError, match="pass std"):
            load_sb3_prior(saved("td3").path)
        with pytest.raises(ValueError, match="pass temperature"):
            load_sb3_prior(saved("dqn").path)
        with pytest.raises(ValueError, match=r"temperature=1\.0 is of no use"):
            load_sb3_prior(saved("ppo").path, temperature=1.0)
        with pytest.raises(ValueError, match="discrete actions"):
            load_sb3_prior(saved("dqn").path, std=0.1, temperature=1.0)
        with pytest.raises(ValueError, match="discrete actions"):
            load_sb3_prior(saved("ppo_discrete").path, std=0.1)
        with pytest.raises(ValueError, match="contradicts the file, whose policy has 'elu'"):
            load_sb3_prior(saved("a2c").path, activation="relu")
        with pytest.raises(ValueError, match="contradicts the file, whose policy has 'tanh'"):
            load_sb3_prior(saved("ppo").path, activation="relu")  # the file names none
        load_sb3_prior(saved("ppo").path, activation="tanh")
        with pytest.raises(ValueError, match="one_hot=True is of no use"):
            load_sb3_prior(saved("ppo").path, one_hot=True)
        with pytest.raises(ValueError, match=r"one for each of 2 dimensions .* got shape \(7,\)"):
            load_sb3_prior(saved("ppo").path, std=torch.ones(7))
        load_sb3_prior(saved("ppo").path, std=torch.ones(2))
        with pytest.raises(ValueError, match="Unknown activation"):
            load_sb3_prior(saved("ppo").path, activation="sin")
        with pytest.raises(ArtifactError, match=r"statistics of observations \(3,\)"):
            load_sb3_prior(saved("ppo_image").path, vecnormalize=saved("ppo").vecnormalize)
        with pytest.raises(FileNotFoundError):
            load_sb3_prior("no.zip")

    def test_statistics_that_leave_observations_alone(self, tmp_path: Path) -> None:
        VecNormalize(DummyVecEnv([Noise]), norm_obs=False).save(str(tmp_path / "vec.pkl"))
        assert read_vecnormalize(tmp_path / "vec.pkl") is None

    def test_custom_layers_are_named(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        for rename, match in (
            (("policy_net.2.", "policy_net.3."), r"not a plain stack of linear"),
            (("value_net.weight", "gate.weight"), r"not known: gate\.weight"),
            (("action_net.", "act."), r"lacks action_net\.weight"),
            (("value_net.weight", "\x1b[2J"), r"not known: \\x1b\[2J\."),
        ):
            path = rewrite(saved("a2c").path, tmp_path / "model.zip", weights=lambda w, r=rename: renamed(w, *r))
            with pytest.raises(ArtifactError, match=match):
                load_sb3_prior(path)

    def test_another_algorithm_is_named(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        def rename(data: dict[str, Any]) -> dict[str, Any]:
            return {**data, "policy_class": {**data["policy_class"], "__module__": "sb3_contrib.ars.policies"}}

        with pytest.raises(ArtifactError, match=r"is one of sb3_contrib\.ars\.policies, and only those of PPO"):
            load_sb3_prior(rewrite(saved("a2c").path, tmp_path / "model.zip", data=rename))


class Bomb:
    """Runs when an ordinary unpickler reads it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


class TestNothingRuns:
    def test_no_code_of_statistics_runs(self, tmp_path: Path) -> None:
        (tmp_path / "vec.pkl").write_bytes(pickle.dumps({"obs_rms": Bomb(tmp_path / "ran")}))
        with pytest.raises(ArtifactError, match=r"pathlib.*nothing in it was run"):
            read_vecnormalize(tmp_path / "vec.pkl")
        assert not (tmp_path / "ran").exists()

    def test_in_a_space_or_the_weights(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        bomb = base64.b64encode(pickle.dumps(Bomb(tmp_path / "ran"))).decode()

        def arm(data: dict[str, Any]) -> dict[str, Any]:
            data["action_space"][":serialized:"] = bomb
            data["policy_class"][":serialized:"] = bomb
            return data

        with pytest.raises(ArtifactError, match="action_space can't be read"):
            load_sb3_prior(rewrite(saved("a2c").path, tmp_path / "a.zip", data=arm))
        with pytest.raises(ArtifactError, match=r"policy\.pth can't be read as tensors"):
            load_sb3_prior(
                rewrite(saved("a2c").path, tmp_path / "b.zip", weights=lambda w: {**w, "x": Bomb(tmp_path / "ran")})
            )
        assert not (tmp_path / "ran").exists()

    @settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(data=st.data())
    def test_damaged_statistics_raise_an_artifact_error_at_most(
        self, saved: Callable[[str], Saved], tmp_path: Path, data: st.DataObject
    ) -> None:
        content = bytearray(saved("ppo").vecnormalize.read_bytes())  # type: ignore[union-attr]
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        end = data.draw(st.sampled_from([len(content), len(content) // 2]))
        (tmp_path / "vec.pkl").write_bytes(content[:end])
        with contextlib.suppress(ArtifactError):  # nothing else; a number may have changed
            read_vecnormalize(tmp_path / "vec.pkl")

    @settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(data=st.data())
    def test_damaged_models_raise_an_artifact_error_at_most(
        self, saved: Callable[[str], Saved], tmp_path: Path, data: st.DataObject
    ) -> None:
        content = bytearray(saved("a2c_linear").path.read_bytes())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        (tmp_path / "model.zip").write_bytes(content)
        with contextlib.suppress(ArtifactError):  # nothing else; parts that are not read may have changed
            load_sb3_prior(tmp_path / "model.zip")
