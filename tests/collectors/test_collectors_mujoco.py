"""The fast steps of MuJoCo's walking tasks are Gymnasium's, to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

import gymnasium
from gymnasium.envs.mujoco import half_cheetah_v5, hopper_v5
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from torchrl_priors.collectors import env_state_dict, load_env_state_dict, make_vector_env
from torchrl_priors.collectors.mujoco_vector_env import MujocoVectorEnv

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")

TASKS = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid")
ASSETS = Path(half_cheetah_v5.__file__).parent / "assets"

# of both versions, and of version 5 only
SHARED: dict[str, dict[str, Any]] = {
    "HalfCheetah": {"forward_reward_weight": 0.7, "ctrl_cost_weight": 0.3},
    "Hopper": {
        "forward_reward_weight": 0.7,
        "ctrl_cost_weight": 0.3,
        "healthy_reward": 0.4,
        "healthy_state_range": (-3.0, 2.0),
        "healthy_z_range": (1.1, 1.4),
        "healthy_angle_range": (-0.1, 0.3),
    },
    "Walker2d": {
        "forward_reward_weight": 0.7,
        "ctrl_cost_weight": 0.3,
        "healthy_reward": 0.4,
        "healthy_z_range": (1.1, 1.24),
        "healthy_angle_range": (-0.1, 0.3),
    },
    "Ant": {
        "ctrl_cost_weight": 0.3,
        "contact_cost_weight": 0.1,
        "healthy_reward": 0.4,
        "healthy_z_range": (0.4, 0.8),
        "contact_force_range": (-0.3, 0.2),
    },
    "Humanoid": {
        "forward_reward_weight": 0.7,
        "ctrl_cost_weight": 0.3,
        "healthy_reward": 0.4,
        "healthy_z_range": (1.35, 1.41),
    },
}
ONLY_5: dict[str, list[dict[str, Any]]] = {
    "HalfCheetah": [{"frame_skip": 2}],
    "Hopper": [{"frame_skip": 2}],
    "Walker2d": [{"frame_skip": 2}],
    "Ant": [
        {"frame_skip": 2, "main_body": "front_left_leg", "forward_reward_weight": 0.7},
        {"include_cfrc_ext_in_observation": False},
    ],
    "Humanoid": [
        {"frame_skip": 2, "contact_cost_weight": 1e-3, "contact_cost_range": (0.1, 0.5)},
        {"include_cinert_in_observation": False, "include_qfrc_actuator_in_observation": False},
        {"include_cvel_in_observation": False, "include_cfrc_ext_in_observation": False},
    ],
}
ANYWHERE = {"exclude_current_positions_from_observation": False, "reset_noise_scale": 0.05, "max_episode_steps": 23}


def cases() -> Iterator[Any]:
    for task in TASKS:
        for version in (4, 5):
            variants = [{}, {**SHARED[task], "max_episode_steps": 23}, ANYWHERE]
            if task != "HalfCheetah":
                variants.append({**SHARED[task], "terminate_when_unhealthy": False})
            if version == 5:
                variants += ONLY_5[task]
            elif task == "Ant":
                variants += [{"use_contact_forces": True, **SHARED[task]}]
            for number, kwargs in enumerate(variants):
                yield pytest.param(f"{task}-v{version}", kwargs, id=f"{task}-v{version}-{number}")


def gymnasiums(env_id: str, number: int, **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gymnasium.make(env_id, **kwargs)] * number, autoreset_mode=AutoresetMode.DISABLED)


def same(one: Any, other: Any) -> bool:
    return all(
        a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        for a, b in zip(one, other, strict=True)
    )


def assert_same_steps(fast: MujocoVectorEnv, plain: SyncVectorEnv, steps: int) -> int:
    """How many episodes ended; actions may be far out of range, of either precision and any order in memory."""
    generator, ended = np.random.default_rng(0), 0
    for step in range(steps):
        actions = generator.normal(size=fast.action_space.shape) * fast.single_action_space.high * (0.3, 1, 3)[step % 3]
        actions = actions.astype(np.float64 if step % 5 == 4 else np.float32, order="F" if step % 4 == 3 else "C")
        found, expected = fast.step(actions), plain.step(actions)
        assert same(found[:4], expected[:4]), f"step {step}"
        if (done := found[2] | found[3]).any():
            ended += int(done.sum())
            fresh = [env.reset(options={"reset_mask": done.copy()}) for env in (fast, plain)]
            assert same(fresh[0][:1], fresh[1][:1])
    return ended


@pytest.mark.parametrize(("env_id", "kwargs"), list(cases()))
def test_steps_are_gymnasiums_to_the_bit(env_id: str, kwargs: dict[str, Any]) -> None:
    fast, plain = make_vector_env(env_id, 3, **kwargs), gymnasiums(env_id, 3, **kwargs)
    assert same(fast.reset(seed=1)[:1], plain.reset(seed=1)[:1])
    ended = assert_same_steps(fast, plain, steps=60)
    assert fast.fast
    if kwargs.get("max_episode_steps"):
        assert ended >= 6


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("number", [1, 8])
def test_any_number_of_environments(task: str, number: int) -> None:
    fast, plain = make_vector_env(f"{task}-v5", number), gymnasiums(f"{task}-v5", number)
    for env in (fast, plain):
        env.reset(seed=[7] * number)
    assert_same_steps(fast, plain, steps=20)
    assert fast.fast


@pytest.mark.parametrize("task", TASKS)
def test_a_state_goes_from_one_kind_of_vector_to_the_other(task: str) -> None:
    fast, plain = (
        make_vector_env(f"{task}-v5", 2, max_episode_steps=30),
        gymnasiums(f"{task}-v5", 2, max_episode_steps=30),
    )
    for env in (fast, plain):
        env.reset(seed=2)
    assert_same_steps(fast, plain, steps=17)
    states = [env_state_dict(env) for env in (fast, plain)]
    assert states[0]["attributes"] == states[1]["attributes"]
    assert states[0]["physics"].equal(states[1]["physics"])
    assert_same_steps(fast, plain, steps=5)
    load_env_state_dict(fast, states[1])  # of an env that has run
    load_env_state_dict(plain, states[0])
    assert_same_steps(fast, plain, steps=40)
    fresh = make_vector_env(f"{task}-v5", 2, max_episode_steps=30)
    load_env_state_dict(fresh, states[0])
    load_env_state_dict(plain, states[1])
    assert assert_same_steps(fresh, plain, steps=40) >= 2


def test_a_model_that_is_changed_counts() -> None:
    fast, plain = make_vector_env("Humanoid-v5", 2), gymnasiums("Humanoid-v5", 2)
    for env in (fast, plain):
        env.envs[1].unwrapped.model.body_mass[:] *= np.linspace(0.5, 2, 14)
        env.reset(seed=0)
    assert_same_steps(fast, plain, steps=30)
    assert fast.fast


def test_another_xml_file_takes_gymnasiums_steps() -> None:
    kwargs = {"xml_file": str(ASSETS / "walker2d.xml"), "healthy_z_range": (0.5, 2.0)}
    fast, plain = make_vector_env("Walker2d-v5", 2, **kwargs), gymnasiums("Walker2d-v5", 2, **kwargs)
    for env in (fast, plain):
        env.reset(seed=0)
    assert_same_steps(fast, plain, steps=30)
    assert fast.fast


class Custom(hopper_v5.HopperEnv):
    def _get_obs(self) -> np.ndarray:
        return 2 * super()._get_obs()


class Mixed(gymnasium.Wrapper):
    def step(self, action: np.ndarray) -> Any:
        obs, reward, *others = self.env.step(action)
        return obs, 2 * reward, *others


class TestPlainSteps:
    """What is not known is stepped by Gymnasium, whose infos come with it."""

    @pytest.mark.parametrize(
        "make",
        [
            lambda: gymnasium.make("Pendulum-v1"),
            lambda: gymnasium.make("Reacher-v5"),
            lambda: gymnasium.wrappers.TimeLimit(Custom(), 20),
            lambda: Mixed(gymnasium.make("Hopper-v5")),
        ],
    )
    def test_other_environments_and_wrappers(self, make: Any) -> None:
        env = MujocoVectorEnv([make] * 2)
        plain = SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.DISABLED)
        for each in (env, plain):
            each.reset(seed=0)
        assert_same_steps(env, plain, steps=10)
        assert not env.fast

    def test_environments_made_with_different_arguments(self) -> None:
        makers = [lambda w=w: gymnasium.make("Hopper-v5", healthy_reward=w) for w in (1.0, 2.0)]
        assert not MujocoVectorEnv(makers).fast

    def test_an_attribute_set_later_makes_steps_plain(self) -> None:
        env, plain = make_vector_env("HalfCheetah-v5", 2), gymnasiums("HalfCheetah-v5", 2)
        for each in (env, plain):
            each.reset(seed=0)
        assert_same_steps(env, plain, steps=5)
        for each in (env, plain):
            each.set_attr("_ctrl_cost_weight", [0.5, 0.6])
        fresh = [each.reset(options={"reset_mask": np.array([True, False])}) for each in (env, plain)]
        assert same(fresh[0][:1], fresh[1][:1])
        assert_same_steps(env, plain, steps=5)
        assert not env.fast

    @pytest.mark.parametrize("change", ["other formula", "other internals"])
    def test_another_version_of_gymnasium(self, change: str, monkeypatch: pytest.MonkeyPatch) -> None:
        if change == "other formula":
            monkeypatch.setattr(half_cheetah_v5.HalfCheetahEnv, "control_cost", lambda self, action: 0.0)
        else:
            cost = half_cheetah_v5.HalfCheetahEnv.control_cost

            def renamed(self: Any, action: np.ndarray) -> Any:
                self._ctrl_cost_weight = 0.1
                try:
                    return cost(self, action)
                finally:
                    del self._ctrl_cost_weight

            monkeypatch.setattr(half_cheetah_v5.HalfCheetahEnv, "control_cost", renamed)
        env, plain = make_vector_env("HalfCheetah-v5", 2), gymnasiums("HalfCheetah-v5", 2)
        for each in (env, plain):
            each.reset(seed=0)
        assert env.fast
        assert_same_steps(env, plain, steps=5)
        assert not env.fast

    def test_actions_of_the_wrong_shape_are_refused_as_by_gymnasium(self) -> None:
        env = make_vector_env("HalfCheetah-v5", 2)
        env.reset(seed=0)
        for _ in range(3):
            env.step(env.action_space.sample())
        with pytest.raises(ValueError, match="Action dimension mismatch"):
            env.step(np.zeros((2, 5), np.float32))


def test_a_step_before_the_first_reset_or_after_an_end_is_refused_as_by_gymnasium() -> None:
    env = make_vector_env("HalfCheetah-v5", 2, max_episode_steps=4)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    for _ in range(4):
        *_, truncated, infos = env.step(env.action_space.sample())
        assert not infos
    assert truncated.all()
    with pytest.raises(AssertionError):
        env.step(env.action_space.sample())


def test_what_a_step_returned_stays() -> None:
    env = make_vector_env("Hopper-v5", 2)
    env.reset(seed=0)
    steps = [env.step(env.action_space.sample()) for _ in range(4)]
    copies = [[array.copy() for array in step[:4]] for step in steps]
    steps[-1][0][...] = 5.0  # and is the caller's to change
    obs, _ = env.reset(options={"reset_mask": np.array([True, False])})
    assert (obs[1] == copies[-1][0][1]).all()
    env.step(env.action_space.sample())
    assert all(same(step[:4], copy) for step, copy in zip(steps[:-1], copies[:-1], strict=True))
