"""Collectors that stop and go on; vectors of environments."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

import gymnasium
from collectors_cases import gaussian, same, scripts, squashed
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint

from torchrl_priors.collectors import (
    RunningNorm,
    VectorCollector,
    env_state_dict,
    load_env_state_dict,
    make_vector_env,
)

# Ant and Humanoid read positions that the last step derived before they take the next one; the others do not. The time
# limit ends episodes of those that do not fall.
ENVS = {
    "Hopper-v5": {},
    "HalfCheetah-v5": {"max_episode_steps": 25},
    "Walker2d-v5": {},
    "Ant-v5": {"max_episode_steps": 25},
    "Humanoid-v5": {},
    "Humanoid-v4": {},
    "Reacher-v5": {"max_episode_steps": 25},
}


def sizes(env: SyncVectorEnv) -> tuple[int, int]:
    return env.single_observation_space.shape[0], env.single_action_space.shape[0]


def collector(env_id: str = "Hopper-v5", seed: int = 0, policy: Any = None, **kwargs: Any) -> VectorCollector:
    env = kwargs.pop("env", None) or make_vector_env(env_id, 2, **ENVS[env_id])
    observations, actions = sizes(env)
    kwargs.setdefault("normalizer", RunningNorm(observations))
    kwargs.setdefault("frames_per_batch", 40)
    policy = policy or gaussian(observations, actions, in_key="observation_norm")
    return VectorCollector(env, policy, seed=seed, **kwargs)


def rollouts(collecting: VectorCollector, number: int) -> list[TensorDictBase]:
    return [collecting.rollout() for _ in range(number)]


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
class TestContinuing:
    @pytest.mark.parametrize("env_id", ENVS)
    def test_a_loaded_collector_continues_to_the_bit(self, env_id: str) -> None:
        first = collector(env_id)
        rollouts(first, 2)
        state = first.state_dict()
        expected = rollouts(first, 3)
        assert torch.stack(expected)["next", "done"].any()

        second = collector(env_id, seed=1, policy=first.policy)
        rollouts(second, 1)
        second.load_state_dict(state)
        assert all(same(one, other) for one, other in zip(expected, rollouts(second, 3), strict=True))
        assert second.frames == first.frames == 200
        assert torch.equal(first.normalizer.var, second.normalizer.var)

    def test_a_collector_may_stop_after_every_rollout(self) -> None:
        whole = collector("Humanoid-v5")
        current = collector("Humanoid-v5", policy=whole.policy)
        for expected in rollouts(whole, 5):
            assert same(current.rollout(), expected)
            state = current.state_dict()
            current = collector("Humanoid-v5", seed=9, policy=whole.policy)
            current.load_state_dict(state)

    def test_a_collector_may_stop_before_the_first_rollout(self) -> None:
        first = collector()
        second = collector(seed=1, policy=first.policy)
        second.load_state_dict(first.state_dict())
        assert same(first.rollout(), second.rollout())

    def test_the_frames_before_count(self) -> None:
        first = collector(total_frames=120)
        rollouts(first, 2)
        second = collector(seed=1, policy=first.policy, total_frames=120)
        second.load_state_dict(first.state_dict())
        assert len(list(second)) == 1

    def test_a_saved_state_does_not_move_on_with_its_collector(self) -> None:
        first = collector()
        state = first.state_dict()
        expected = first.rollout()
        rollouts(first, 2)
        first.load_state_dict(state)
        assert same(first.rollout(), expected)

    @pytest.mark.parametrize("way", ["torch", "torchrl"])
    def test_the_state_goes_through_files_without_pickle(self, way: str, tmp_path: Path) -> None:
        first = collector()
        rollouts(first, 2)
        second = collector(seed=1, policy=first.policy)
        if way == "torch":
            file = io.BytesIO()
            torch.save(first.state_dict(), file)
            file.seek(0)
            second.load_state_dict(torch.load(file, weights_only=True))
        else:
            Checkpoint(collector=first).save(tmp_path / "checkpoint")
            Checkpoint(collector=second).load(tmp_path / "checkpoint")
        assert same(first.rollout(), second.rollout())

    def test_another_process_continues_to_the_bit(self, tmp_path: Path) -> None:
        script = f"""
import sys, torch
sys.path[:0] = {[str(Path(__file__).parent), str(Path(__file__).parents[1] / "cases")]!r}
torch.set_num_threads(1)
from test_collectors_state import collector
torch.manual_seed(0)
saved = torch.load({str(tmp_path / "in.pt")!r}, weights_only=True)
collecting = collector("Ant-v5", seed=3)
collecting.policy.load_state_dict(saved["policy"])
collecting.load_state_dict(saved["collector"])
torch.save(collecting.rollout().to_dict(), {str(tmp_path / "out.pt")!r})
"""
        first = collector("Ant-v5")
        rollouts(first, 2)
        torch.save({"policy": first.policy.state_dict(), "collector": first.state_dict()}, tmp_path / "in.pt")
        subprocess.run([sys.executable, "-c", script], check=True, cwd=Path(__file__).parents[2])
        expected, found = first.rollout(), torch.load(tmp_path / "out.pt", weights_only=True)
        for key in ("observation", "action", "action_log_prob"):
            assert torch.equal(expected[key], found[key])
        assert torch.equal(expected["next", "reward"], found["next"]["reward"])

    def test_any_policy_continues_its_random_numbers(self) -> None:
        first = collector(policy=squashed(11, 3, in_key="observation_norm"))
        rollouts(first, 2)
        state = first.state_dict()
        second = collector(seed=1, policy=first.policy)
        second.load_state_dict(state)
        assert same(first.rollout(), second.rollout())

    def test_a_frozen_normaliser_stays_frozen(self) -> None:
        first, second = collector(), collector()
        first.normalizer.freeze()
        second.load_state_dict(first.state_dict())
        assert second.normalizer.frozen


class TestEnvState:
    def test_every_environment_of_a_vector_keeps_its_place(self) -> None:
        env = make_vector_env("Ant-v5", 3, terminate_when_unhealthy=False)
        env.action_space.seed(0)
        env.reset(seed=0)
        actions = [env.action_space.sample() for _ in range(20)]
        for action in actions[:10]:
            env.step(action)
        state = env_state_dict(env)
        expected = [env.step(action) for action in actions[10:]]
        load_env_state_dict(env, state)
        for action, (obs, reward, *_) in zip(actions[10:], expected, strict=True):
            again_obs, again_reward, *_ = env.step(action)
            assert (again_obs == obs).all()
            assert (again_reward == reward).all()

    def test_the_time_limit_counts_on(self) -> None:
        env, other = (make_vector_env("HalfCheetah-v5", 1, max_episode_steps=10) for _ in range(2))
        env.reset(seed=0)
        for _ in range(7):
            env.step(env.action_space.sample())
        load_env_state_dict(other, env_state_dict(env))
        truncated = [bool(other.step(other.action_space.sample())[3][0]) for _ in range(3)]
        assert truncated == [False, False, True]

    def test_resets_continue_their_random_numbers(self) -> None:
        env, other = (make_vector_env("Hopper-v5", 2) for _ in range(2))
        env.reset(seed=0)
        load_env_state_dict(other, env_state_dict(env))
        assert (env.reset()[0] == other.reset()[0]).all()

    @pytest.mark.parametrize(
        ("env", "message"),
        [
            (
                lambda: SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1")], autoreset_mode=AutoresetMode.DISABLED),
                "Pendulum-v1 is not a MuJoCo",
            ),
            (lambda: scripts((3,), (3,)), "Script is not a MuJoCo"),
            (
                lambda: SyncVectorEnv(
                    [lambda: gymnasium.wrappers.NormalizeObservation(gymnasium.make("Hopper-v5"))] * 2,
                    autoreset_mode=AutoresetMode.DISABLED,
                ),
                "NormalizeObservation keeps 'obs_rms'",
            ),
            (
                lambda: gymnasium.wrappers.vector.RecordEpisodeStatistics(make_vector_env("Hopper-v5", 2)),
                "RecordEpisodeStatistics",
            ),
        ],
    )
    def test_what_cannot_be_saved_is_named(self, env: Any, message: str) -> None:
        env = env()
        env.reset(seed=0)
        with pytest.raises(TypeError, match=message):
            env_state_dict(env)

    @pytest.mark.parametrize(
        ("env_id", "number", "kwargs", "message"),
        [
            ("Hopper-v5", 3, {}, "2 environments, there are 3"),
            ("Walker2d-v5", 2, {}, "id Hopper-v5, not Walker2d-v5"),
            ("Hopper-v5", 2, {"ctrl_cost_weight": 0.5}, "arguments"),
            ("Hopper-v5", 2, {"max_episode_steps": 10}, "max_episode_steps 1000, not 10"),
            ("Hopper-v5", 2, {"disable_env_checker": True}, "layers"),
        ],
    )
    def test_the_state_of_others_is_refused(self, env_id: str, number: int, kwargs: Any, message: str) -> None:
        env, other = make_vector_env("Hopper-v5", 2), make_vector_env(env_id, number, **kwargs)
        env.reset(seed=0)
        other.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            load_env_state_dict(other, env_state_dict(env))

    def test_a_collector_refuses_the_state_of_another_kind(self) -> None:
        first, other = collector(), collector("Walker2d-v5")
        raw = collector(policy=gaussian(11, 3), normalizer=None)
        with pytest.raises(ValueError, match="normalizer"):
            raw.load_state_dict(first.state_dict())
        with pytest.raises(ValueError, match="shape"):
            other.load_state_dict(first.state_dict())


class TestMakeVectorEnv:
    def test_mujocos_deprecations_leave_no_trace(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
    ) -> None:
        monkeypatch.chdir(tmp_path)
        make_vector_env("HalfCheetah-v5", 2)
        assert not list(tmp_path.iterdir())
        assert not "".join(capfd.readouterr())

    def test_the_users_handler_of_mujocos_warnings_comes_back(self) -> None:
        import mujoco

        def handler(message: str) -> None:
            pass

        mujoco.set_mju_user_warning(handler)
        try:
            make_vector_env("HalfCheetah-v5", 1)
            assert mujoco.get_mju_user_warning() is handler
        finally:
            mujoco.set_mju_user_warning(None)

    def test_arguments_reach_each_environment(self) -> None:
        env = make_vector_env("Humanoid-v5", 2, ctrl_cost_weight=0.001, max_episode_steps=7)
        assert env.num_envs == 2
        for sub in env.envs:
            assert sub.spec.max_episode_steps == 7
            assert sub.unwrapped._ctrl_cost_weight == 0.001

    def test_no_environments_are_refused(self) -> None:
        with pytest.raises(ValueError, match="num_envs"):
            make_vector_env("Hopper-v5", 0)
