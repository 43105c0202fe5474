"""Claims about teachers of Stable-Baselines3."""

from __future__ import annotations

import base64
import contextlib
import pickle
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hydra import compose, initialize_config_dir
from sb3_cases import (
    A2C,
    BOX,
    MODELS,
    NUMBER,
    PPO,
    STD,
    DummyVecEnv,
    Noise,
    Saved,
    VecNormalize,
    batch_of,
    observations,
    rewrite,
)
from tensordict import TensorDict
from torch import nn
from torchrl.data import OneHot
from torchrl.envs import ActionScaling, GymWrapper, TransformedEnv

from recipes.export_sb3 import export
from torchrl_priors.artifacts import ArtifactError, load_prior, load_sb3_prior, save_prior
from torchrl_priors.priors import BoltzmannPrior, ModulePrior, RescaledPrior

CONF = Path(__file__).parents[2] / "conf"


TOLERANCE = {"atol": 1e-6, "rtol": 0.0}


def convert(model: Saved, name: str, **kwargs: Any) -> ModulePrior | BoltzmannPrior:
    return load_sb3_prior(model.path, vecnormalize=model.vecnormalize, **MODELS[name].told, **kwargs)


@pytest.fixture(params=MODELS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


class TestConversion:
    def test_same_deterministic_actions(self, saved: Callable[[str], Saved], name: str) -> None:
        model, raw = saved(name), observations(MODELS[name])
        seen = model.env.normalize_obs(raw) if model.vecnormalize else raw
        expected = torch.as_tensor(model.model.predict(seen, deterministic=True)[0])
        dist = convert(model, name).get_dist(batch_of(raw))
        if expected.is_floating_point():
            action = dist.deterministic_sample if name == "sac" else dist.mean
            torch.testing.assert_close(action, expected, **TOLERANCE)
            assert expected.std(0).min() > 0.01  # not all at a bound
        else:
            assert torch.equal(dist.probs.argmax(-1), expected)
            assert len(expected.unique()) > 1

    def test_log_probabilities_are_those_of_stable_baselines3(self, saved: Callable[[str], Saved], name: str) -> None:
        model, raw = saved(name), observations(MODELS[name])
        seen = model.env.normalize_obs(raw) if model.vecnormalize else raw
        policy = model.model.policy
        tensor = policy.obs_to_tensor(seen)[0]
        prior, batch = convert(model, name, clip_mean=False), batch_of(raw)
        with torch.no_grad():
            if MODELS[name].told == STD:
                pytest.skip("it has no distribution of its own, or none that is read")
            if name == "sac":
                # in float64, as the inverse of tanh amplifies rounding
                mean, log_std, _ = policy.actor.get_action_dist_params(tensor)
                assert log_std.max() == 2  # it is clamped
                dist = policy.actor.action_dist.proba_distribution(mean.double(), log_std.double())
                before = mean.double().clamp(-2, 2) + 0.5 * torch.randn(NUMBER, 2, dtype=torch.float64)
                scaled = before.tanh()
                low, high = torch.as_tensor(BOX.low).double(), torch.as_tensor(BOX.high).double()
                # SB3's is of the scaled action, and adds 1e-6 within the logarithm
                expected = dist.log_prob(scaled, before) + (1 - scaled**2 + 1e-6).log().sum(-1)
                expected = expected - ((1 - scaled**2) * (high - low) / 2).log().sum(-1)
                batch["action"] = low + 0.5 * (scaled + 1) * (high - low)
                params = {key: value.double() for key, value in prior.get_params(batch).items()}
                found = prior.log_prob(batch, dist=prior.build_dist(params))
            elif name.startswith("dqn"):
                values = policy.q_net(tensor)
                batch["action"] = values.argmin(-1)
                expected = (values / 0.5).log_softmax(-1).min(-1).values
                found = prior.log_prob(batch)
            else:
                dist = policy.get_distribution(tensor)
                batch["action"] = dist.get_actions()
                expected = dist.log_prob(batch["action"])
                found = prior.log_prob(batch)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)

    def test_round_trip_through_a_file(self, saved: Callable[[str], Saved], name: str, tmp_path: Path) -> None:
        prior, batch = convert(saved(name), name), batch_of(observations(MODELS[name], 20))
        save_prior(tmp_path / "teacher", prior, env_id="Noise-v0")
        loaded = load_prior(tmp_path / "teacher", env_id="Noise-v0")
        for key, value in prior.get_params(batch).items():
            assert torch.equal(loaded.get_params(batch)[key], value), key
        batch["action"] = prior.get_dist(batch).sample()
        assert torch.equal(loaded.log_prob(batch), prior.log_prob(batch))

    def test_neither_sb3_nor_gymnasium_is_imported(
        self, saved: Callable[[str], Saved], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        model = saved("ppo")
        for module in [module for module in sys.modules if module.split(".")[0] in ("stable_baselines3", "gymnasium")]:
            monkeypatch.setitem(sys.modules, module, None)  # makes the import of it fail
        convert(model, "ppo")

    def test_no_random_number_is_drawn(self, saved: Callable[[str], Saved]) -> None:
        model = saved("sac")
        before = torch.get_rng_state()
        convert(model, "sac")
        assert torch.equal(torch.get_rng_state(), before)

    def test_shape_of_the_batch_does_not_matter(self, saved: Callable[[str], Saved], name: str) -> None:
        prior, raw = convert(saved(name), name), torch.as_tensor(observations(MODELS[name], 6))
        flat = prior(TensorDict(observation=raw, batch_size=[6]))
        grid = prior(TensorDict(observation=raw.unflatten(0, (2, 3)), batch_size=[2, 3]))
        for key in prior.out_keys:
            torch.testing.assert_close(grid[key].flatten(0, 1), flat[key])

    def test_a_spread_makes_any_continuous_teacher_gaussian(self, saved: Callable[[str], Saved]) -> None:
        model, batch = saved("sac"), batch_of(observations(MODELS["sac"], 20))
        squashed = convert(model, "sac").get_dist(batch)
        normal = load_sb3_prior(model.path, vecnormalize=model.vecnormalize, std=0.3).get_dist(batch)
        torch.testing.assert_close(normal.mean, squashed.deterministic_sample, **TOLERANCE)
        assert (normal.stddev == 0.3).all()

    @pytest.mark.parametrize("std", [None, 0.3])
    def test_the_mean_stays_within_the_bounds_unless_it_shall_be_raw(
        self, saved: Callable[[str], Saved], std: float | None, tmp_path: Path
    ) -> None:
        batch, low, high = batch_of(observations(MODELS["a2c"])), torch.as_tensor(BOX.low), torch.as_tensor(BOX.high)
        clipped, raw = (load_sb3_prior(saved("a2c").path, std=std, clip_mean=clip) for clip in (True, False))
        mean = raw.get_dist(batch).mean
        assert (mean > high).any()
        assert (mean < low).any()
        save_prior(tmp_path / "teacher", clipped, env_id="Noise-v0")
        for prior in (clipped, load_prior(tmp_path / "teacher")):
            assert torch.equal(prior.get_dist(batch).mean, mean.clamp(low, high))
            assert torch.equal(prior.get_dist(batch).stddev, raw.get_dist(batch).stddev)

    @pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (-np.inf, 0.2)])
    def test_actions_without_a_bound_are_not_clipped_there(
        self, saved: Callable[[str], Saved], tmp_path: Path, low: float, high: float
    ) -> None:
        space = base64.b64encode(pickle.dumps(spaces.Box(low, high, (2,)))).decode()
        change = {"action_space": {":serialized:": space}}
        path = rewrite(saved("a2c").path, tmp_path / "model.zip", data=lambda data: {**data, **change})
        batch = batch_of(observations(MODELS["a2c"]))
        found, raw = (load_sb3_prior(path, clip_mean=clip) for clip in (True, False))
        mean = raw.get_dist(batch).mean
        assert mean.max() > 0.2
        assert torch.equal(found.get_dist(batch).mean, mean.clamp(low, high))

    def test_discrete_advice_can_be_one_hot(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        path, batch = saved("ppo_discrete").path, batch_of(observations(MODELS["ppo_discrete"], 20))
        save_prior(tmp_path / "teacher", load_sb3_prior(path, one_hot=True), env_id="Noise-v0")
        prior = load_prior(tmp_path / "teacher", observation_spec=3, action_spec=OneHot(5))
        indices = load_sb3_prior(path).get_dist(batch).sample()
        batch["action"] = nn.functional.one_hot(indices, 5)
        expected = load_sb3_prior(path).log_prob(batch.clone().set("action", indices))
        torch.testing.assert_close(prior.log_prob(batch), expected)

    @pytest.mark.usefixtures("without_torchrls_groups")
    def test_the_command_writes_a_teacher(self, saved: Callable[[str], Saved], tmp_path: Path) -> None:
        model = saved("ppo")
        out = str(tmp_path / "teacher.safetensors")
        with initialize_config_dir(str(CONF), version_base="1.3"):
            overrides = [f"model={model.path}", f"vecnormalize={model.vecnormalize}", "env_id=Noise-v0", f"out={out}"]
            export(compose("export_sb3", overrides))
        prior = load_prior(out, env_id="Noise-v0", observation_spec=3, action_spec=2)
        batch = batch_of(observations(MODELS["ppo"], 5))
        assert torch.equal(prior.get_dist(batch).mean, convert(model, "ppo").get_dist(batch).mean)
        with pytest.raises(ArtifactError, match=r"actions of shape \(2,\), and the student's are 3"):
            load_prior(out, observation_spec=3, action_spec=3)
        with pytest.raises(ArtifactError, match=r"can't read observations of shape \(4,\)"):
            load_prior(out, observation_spec=4, action_spec=2)
        with pytest.raises(ArtifactError, match="prior of Noise-v0"):
            load_prior(out, env_id="Hopper-v5")

    @pytest.mark.usefixtures("without_torchrls_groups")
    def test_the_command_writes_no_teacher_that_a_gaussian_student_cannot_learn_from(
        self, saved: Callable[[str], Saved], tmp_path: Path
    ) -> None:
        overrides = [f"model={saved('sac').path}", "env_id=Noise-v0", f"out={tmp_path / 'teacher.safetensors'}"]
        with initialize_config_dir(str(CONF), version_base="1.3"):
            without, given = (compose("export_sb3", overrides + more) for more in ([], ["std=0.1"]))
        with pytest.raises(ValueError, match=r"std=null: .* squashed"):
            export(without)
        assert not list(tmp_path.iterdir())
        export(given)
        assert load_prior(tmp_path / "teacher.safetensors").get_dist(batch_of(observations(MODELS["sac"], 1))).stddev[
            0, 0
        ] == pytest.approx(0.1)


class TestWhatIsForgotten:
    @pytest.mark.parametrize("name", MODELS)
    def test_statistics_that_an_on_policy_model_had(self, saved: Callable[[str], Saved], name: str) -> None:
        case = MODELS[name]
        warned = case.normalize and case.algorithm in (PPO, A2C)
        with pytest.warns(UserWarning, match="was trained with VecNormalize") if warned else no_warning():
            load_sb3_prior(saved(name).path, **case.told)
        with no_warning():
            convert(saved(name), name)

    def test_statistics_of_rewards_alone(self, tmp_path: Path) -> None:
        env = VecNormalize(DummyVecEnv([Noise]), norm_obs=False)
        PPO("MlpPolicy", env, device="cpu", n_steps=8, batch_size=8).learn(8).save(tmp_path / "model.zip")
        env.save(str(tmp_path / "vec.pkl"))
        with pytest.warns(UserWarning, match="also if it only normalised rewards"):
            load_sb3_prior(tmp_path / "model.zip")
        with no_warning():
            load_sb3_prior(tmp_path / "model.zip", vecnormalize=tmp_path / "vec.pkl")

    @pytest.mark.parametrize("name", ["a2c", "sac", "td3", "ppo_sde"])
    def test_a_student_of_another_unit_is_refused_and_takes_a_rescaled_prior(
        self, saved: Callable[[str], Saved], name: str
    ) -> None:
        env = TransformedEnv(GymWrapper(Noise()), ActionScaling())
        convert(saved(name), name, action_spec=env.base_env.action_spec)
        with pytest.raises(ArtifactError, match=r"acts within .*2\.0, 0\.75.* within .*RescaledPrior"):
            convert(saved(name), name, action_spec=env.action_spec)
        with pytest.raises(ArtifactError, match=r"acts within .*2\.0, 0\.75"):
            convert(saved(name), name, action_spec=env.action_spec, clip_mean=False)
        prior = RescaledPrior(convert(saved(name), name), *map(torch.as_tensor, (BOX.low, BOX.high)))
        batch = batch_of(observations(MODELS[name], 20))
        mean = prior.get_dist(batch).deterministic_sample if name == "sac" else prior.get_dist(batch).mean
        assert mean.abs().max() <= 1 + 1e-6
        with pytest.raises(ArtifactError, match=r"actions of shape \(2,\)"):
            convert(saved(name), name, action_spec=OneHot(2))


@contextlib.contextmanager
def no_warning() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
