"""The recipe in environments that are none of MuJoCo's: discrete and continuous actions, resumed, refused, reported."""

from __future__ import annotations

import json
import re

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict

pytest.importorskip("mujoco")
from mujoco_cases import config, interrupt, run

from recipes.mujoco.__main__ import with_env
from recipes.report.runs import find, read
from recipes.show_weight.episode import load_agent, play, weigh
from torchrl_priors import load_prior

ENVS = {
    "CartPole-v1": ["env=any", "env.id=CartPole-v1", "total_frames=256"],
    "Pendulum-v1": ["env=any", "env.id=Pendulum-v1", "total_frames=256", "+env.kwargs.max_episode_steps=16"],
}
SHORT = ["trial.max_frames=128", "trial.min_frames=64"]


@pytest.fixture(scope="module", params=ENVS)
def env(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def taught(env, tmp_path_factory) -> list[str]:
    """What a run of the environment with a teacher is given."""
    made = run(tmp_path_factory.mktemp("teacher"), *ENVS[env]) / "policy.safetensors"
    return [*ENVS[env], f"prior.path={made}", *SHORT]


@pytest.mark.parametrize("method", ["e2r", "ae2r", "trial"])
def test_every_kind_of_method_trains_and_makes_a_teacher(method, env, taught, tmp_path):
    out = run(tmp_path, *taught, f"method={method}")
    metrics = pd.read_csv(out / "metrics.csv")
    assert metrics["loss_objective"].notna().all()
    assert metrics["frames"].iloc[-1] == 256
    prior = load_prior(out / "policy.safetensors", env_id=env)
    assert prior.param_names == (["logits"] if env == "CartPole-v1" else ["loc", "scale"])
    kept = json.loads((out / "teacher.json").read_text())
    assert set(kept["teachers"]) == {"policy"}
    assert set(kept["students"]) == ({"alone", "policy"} if method == "trial" else set())
    assert kept["policy"]["frames"] == 256


def test_the_exported_policy_is_the_student_and_its_weight_is_shown(taught, tmp_path):
    out = run(tmp_path, *taught, "method=ae2r")
    agent, task = load_agent(out, None)
    observation = torch.randn(7, task.obs_dim)
    states = TensorDict(observation=observation, observation_norm=agent.normalizer(observation), batch_size=[7])
    student, exported = agent.actor.get_dist(states), load_prior(out / "policy.safetensors").get_dist(states)
    assert type(student) is type(exported)
    torch.testing.assert_close(exported.mean, student.mean, equal_nan=True)
    torch.testing.assert_close(exported.entropy(), student.entropy())
    episode = play(agent, task, seed=0, steps=20)
    weight = weigh(agent, episode)["weight"]
    assert ((weight > 0) & (weight < 1)).all()


def test_an_interrupted_run_gives_the_same_files(taught, tmp_path, monkeypatch):
    options = [*taught, "method=trial"]
    whole = run(tmp_path / "whole", *options)
    interrupt(monkeypatch, tmp_path / "stopped", 192, *options)  # it goes on from 128
    run(tmp_path / "stopped", *options)
    for name in ("eval.csv", "policy.safetensors", "trials.json", "teacher.json"):
        assert (tmp_path / "stopped" / name).read_bytes() == (whole / name).read_bytes()


def test_lunar_lander_is_resumed_within_an_episode(tmp_path, monkeypatch):
    pytest.importorskip("Box2D")
    options = ["env=any", "env.id=LunarLander-v3", "total_frames=128"]
    whole = run(tmp_path / "whole", *options)
    interrupt(monkeypatch, tmp_path / "stopped", 128, *options)  # it goes on from 64
    run(tmp_path / "stopped", *options)
    assert (tmp_path / "stopped/policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()


def test_a_compiled_step_trains_a_discrete_student_as_an_eager_one(tmp_path):
    from recipes.common.checks import require_compiler

    try:
        require_compiler(True)
    except ValueError:
        pytest.skip("no C++ compiler")
    runs = [run(tmp_path / which, *ENVS["CartPole-v1"], f"compile={which}") for which in ("true", "false")]
    compiled, eager = (pd.read_csv(out / "metrics.csv").filter(like="loss_") for out in runs)
    pd.testing.assert_frame_equal(compiled, eager, rtol=1e-3, atol=1e-5)


def test_the_trial_is_the_method_where_there_is_a_teacher_and_none_is_given(taught, tmp_path):
    assert config(tmp_path, *taught).method == "trial"
    assert config(tmp_path, *taught, "method=er").method == "er"
    assert config(tmp_path, "env=hopper").method == "none"


@pytest.mark.parametrize(
    ("words", "chosen"),
    [
        (["env.id=LunarLander-v3"], True),
        (["-m", "env.id=A-v1,B-v2"], True),
        (["env=hopper", "env.id=Hopper-v4"], False),
        (["env.id=Walker2d"], False),
        (["seed=1"], False),
    ],
)
def test_an_id_with_its_version_chooses_the_settings_of_an_unknown_environment(words, chosen):
    assert with_env(words) == ([*words, "env=any"] if chosen else words)


def test_the_table_says_what_the_teacher_was_worth(taught, tmp_path, capsys):
    run(tmp_path, *taught)
    said = capsys.readouterr().out
    said = said[said.index("Returns:") :]
    own = json.loads((tmp_path / "teacher.json").read_text())["teachers"]["policy"]
    (trial,) = json.loads((tmp_path / "trials.json").read_text())
    last = pd.read_csv(tmp_path / "eval.csv").iloc[-1]
    for row in (
        rf"teacher policy +{own['mean_return']:.1f} ± {own['std_return']:.1f}  2 episodes of its own",
        rf"student alone +{trial['returns']['alone']:.1f}  recent .* at {trial['frames']['alone']} frames",
        rf"student taught by policy +{trial['returns']['policy']:.1f}  recent ",
        rf"policy\.safetensors +{last['mean_return']:.1f} ± {last['std_return']:.1f}  2 episodes, at 256 frames",
        "Decision: the student went on (alone|with policy) ",
    ):
        assert re.search(row, said), row
    run(tmp_path, *taught)  # finished already
    assert capsys.readouterr().out.endswith(said)


def test_a_report_draws_the_line_of_the_teacher(taught, tmp_path):
    run(tmp_path, *taught, "method=e2r")
    own = json.loads((tmp_path / "teacher.json").read_text())["teachers"]["policy"]["mean_return"]
    assert [found.teacher_return for found in read(find(str(tmp_path)))[0]] == [own]
    (tmp_path / "teacher.json").write_text("{}")
    assert [left.reason for left in read(find(str(tmp_path)))[1]] == ["teacher.json is damaged"]


class Toy(gymnasium.Env):
    """An environment of any spaces."""

    def __init__(self, observations: spaces.Space, actions: spaces.Space) -> None:
        self.observation_space, self.action_space = observations, actions

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


FLAT, REAL = spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,))
REFUSED = {
    "Dict": (spaces.Dict(a=FLAT), REAL, "observation space must be a Box"),
    "Image": (spaces.Box(0, 255, (8, 8, 3), np.uint8), REAL, "must have one dimension"),
    "Multi": (FLAT, spaces.MultiDiscrete([2, 3]), "action space must be"),
    "Shifted": (FLAT, spaces.Discrete(3, start=1), "Discrete from 0 on"),
    "Matrix": (FLAT, spaces.Box(-1, 1, (2, 2)), "must have one dimension"),
    "Whole": (FLAT, spaces.Box(0, 9, (2,), np.int64), "action space must be"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_spaces_are_refused_by_name(name, tmp_path, monkeypatch):
    observations, actions, message = REFUSED[name]
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.envs.registration.registry))
    gymnasium.register(f"{name}-v0", lambda: Toy(observations, actions), disable_env_checker=True)
    with pytest.raises(SystemExit, match=rf"^Error: env={name}-v0: cannot be used") as error:
        run(tmp_path / "out", "env=any", f"env.id={name}-v0")
    assert message in str(error.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["env.id=NoSuch-v0"], "env=NoSuch-v0: cannot be used (NameNotFound"),
        (["env.id=Pendulum-v99"], "env=Pendulum-v99: cannot be used (VersionNotFound"),
        ([], "env.id=: expected a value"),
    ],
)
def test_an_unknown_environment_is_refused_by_name(options, message, tmp_path):
    with pytest.raises(SystemExit, match=r"^Error: ") as error:
        run(tmp_path / "out", "env=any", *options)
    assert message in str(error.value)


def test_whole_numbers_are_observations_too(tmp_path, monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.envs.registration.registry))
    ram = spaces.Box(0, 255, (4,), np.uint8, seed=0)
    gymnasium.register("Ram-v0", lambda: Toy(ram, spaces.Discrete(2)), max_episode_steps=5, disable_env_checker=True)
    out = run(tmp_path, "env=any", "env.id=Ram-v0", "total_frames=64")
    assert pd.read_csv(out / "eval.csv")["mean_length"].tolist() == [5.0, 5.0]
