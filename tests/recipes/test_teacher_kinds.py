"""Each kind of teacher that ``prior.path`` takes, and what a run makes of it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

pytest.importorskip("mujoco")
pytest.importorskip("stable_baselines3")
from mujoco_cases import config, run
from own_teacher_cases import BOT, CARTPOLE, PENDULUM, given_to, write_teachers

from recipes.mujoco.agent import make_prior
from recipes.mujoco.run import Run
from recipes.mujoco.task import open_task
from recipes.mujoco.teachers import ReversedPrior
from torchrl_priors import CallablePrior


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("teachers")
    write_teachers(folder)
    return folder


@pytest.fixture
def _importable(folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    yield
    sys.modules.pop("bot_of_a_test", None)


KINDS = [
    ("ppo.zip", PENDULUM, []),
    ("normalised.zip", PENDULUM, ["prior.vecnormalize={folder}/vec.pkl"]),
    ("sac.zip", PENDULUM, []),
    ("td3.zip", PENDULUM, ["prior.std=0.3"]),
    ("cartpole.zip", CARTPOLE, []),
    ("dqn.zip", CARTPOLE, ["prior.temperature=1"]),
    ("logits.pt", CARTPOLE, ["prior.outputs=[logits]", "prior.trust_code=true"]),
    ("index.pt", CARTPOLE, ["prior.outputs=[action]", "prior.trust_code=true"]),
    ("action.pt", PENDULUM, ["prior.outputs=[action]", "prior.trust_code=true"]),
    ("gaussian.pt", PENDULUM, ["prior.outputs=[loc,scale]", "prior.trust_code=true"]),
    ("bot_of_a_test:brake", PENDULUM, ["prior.trust_code=true"]),
    ("bot_of_a_test:push", CARTPOLE, ["prior.trust_code=true", "prior.epsilon=0.2"]),
]


@pytest.mark.usefixtures("_importable")
@pytest.mark.parametrize(("name", "env", "options"), KINDS, ids=[name for name, *_ in KINDS])
def test_a_student_learns_from_each_kind_of_teacher(name, env, options, folder, tmp_path):
    out = run(tmp_path / "out", *given_to(name, folder, env, options), "method=kickstart", "total_frames=64")
    (played,) = json.loads((out / "teacher.json").read_text())["teachers"].values()
    assert played["episodes"] == 2
    assert len(json.loads((out / "config.json").read_text())["prior"]["sha256"]) == 64


@pytest.mark.usefixtures("_importable")
def test_several_kinds_compete_in_one_trial(folder, tmp_path):
    paths = f"prior.path=['bot_of_a_test:brake',{folder}/ppo.zip]"
    out = run(tmp_path, *PENDULUM, paths, "prior.trust_code=true", "total_frames=384")
    (trial,) = json.loads((out / "trials.json").read_text())
    assert set(trial["returns"]) == {"alone", "bot_of_a_test:brake", "ppo"}


@pytest.mark.usefixtures("_importable")
def test_the_spread_of_an_action_is_a_tenth_of_its_range_or_as_given(folder, tmp_path):
    state = TensorDict(observation=torch.tensor([[1.0, 0.0, 0.5]]), batch_size=[1])
    for name, options, scale in (
        ("bot_of_a_test:brake", ["prior.trust_code=true"], 0.4),
        ("bot_of_a_test:brake", ["prior.trust_code=true", "prior.std=0.7"], 0.7),
        ("sac.zip", [], 0.4),
        ("td3.zip", [], 0.4),
        ("ppo.zip", [], 1.0),
        ("ppo.zip", ["prior.std=0.7"], 0.7),
    ):
        cfg = config(tmp_path, *given_to(name, folder, PENDULUM, options), "method=e2r")
        (prior,) = open_task(cfg).teachers.values()
        assert prior.get_dist(state.copy()).stddev.item() == pytest.approx(scale), name


@pytest.mark.usefixtures("_importable")
@pytest.mark.parametrize(("name", "env"), [("bot_of_a_test:brake", PENDULUM), ("bot_of_a_test:push", CARTPOLE)])
def test_a_reversed_teacher_does_the_opposite(name, env, tmp_path):
    cfg = config(tmp_path, *env, f"prior.path={name}", "method=e2r", "prior.trust_code=true", "prior.degrade=reversed")
    task = open_task(cfg)
    features = 3 if env is PENDULUM else 4
    states = TensorDict(observation=torch.randn(20, features), batch_size=[20])
    good, bad = task.teachers[name].get_dist(states.copy()), make_prior(cfg, task).get_dist(states.copy())
    if env is PENDULUM:
        torch.testing.assert_close(bad.mean, -good.mean)
        torch.testing.assert_close(bad.stddev, good.stddev)
    else:
        torch.testing.assert_close(bad.probs, good.probs.flip(-1))


@pytest.mark.parametrize(("low", "high", "mean"), [(0.0, 1.0, 0.8), (-1.0, 1.0, -0.2), (-np.inf, np.inf, -0.2)])
def test_a_mean_is_mirrored_at_the_middle_of_the_actions(low, high, mean):
    actions = Bounded(torch.tensor([low]), torch.tensor([high]), dtype=torch.float32)
    prior = ReversedPrior(CallablePrior(lambda observation: [0.2], std=0.1), actions)
    state = TensorDict(observation=torch.zeros(1, 3), batch_size=[1])
    assert prior.get_dist(state).mean.item() == pytest.approx(mean)


@pytest.mark.usefixtures("_importable")
def test_the_identity_covers_what_is_read_and_nothing_else(folder, tmp_path):
    def identity(*options: str) -> dict:
        return Run(config(tmp_path / str(len([*tmp_path.iterdir()])), *options, "method=e2r")).folder.config["prior"]

    code = [*PENDULUM, "prior.path=bot_of_a_test:brake", "prior.trust_code=true"]
    before = identity(*code)
    assert before["path"] == "bot_of_a_test:brake"
    assert "trust_code" not in before
    assert identity(*code, "prior.temperature=3") == before  # of action values
    assert identity(*code, "prior.std=0.3") != before
    source = folder / "bot_of_a_test.py"
    source.write_text(BOT + "# changed\n")
    assert identity(*code)["sha256"] != before["sha256"]
    source.write_text(BOT)
    zipped = given_to("normalised.zip", folder, PENDULUM, ["prior.vecnormalize={folder}/vec.pkl"])
    assert identity(*zipped)["vecnormalize"] == "vec.pkl"
    assert identity(*zipped)["vecnormalize_sha256"] != identity(*zipped[:-1]).get("vecnormalize_sha256")
    assert set(identity("env=hopper")) == {"path", "degrade", "feature", "threshold", "prob"}
