"""Each kind of teacher that ``prior.path`` takes, what it needs, and what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded

pytest.importorskip("mujoco")
pytest.importorskip("stable_baselines3")
from mujoco_cases import config, run
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from recipes.mujoco.agent import make_prior
from recipes.mujoco.run import Run
from recipes.mujoco.task import open_task
from recipes.mujoco.teachers import ReversedPrior
from recipes.show_weight.episode import load_agent
from torchrl_priors import CallablePrior

SHORT = ["trial.max_frames=128", "trial.min_frames=64", "total_frames=256"]
CARTPOLE = ["env=any", "env.id=CartPole-v1", *SHORT]
PENDULUM = ["env=any", "env.id=Pendulum-v1", "+env.kwargs.max_episode_steps=16", *SHORT]
BOT = """
import numpy as np

def brake(observation):
    return -observation[2:]

def push(observation):
    return int(observation[2] > 0)

def flat(observation):
    return -float(observation[2])

def whole(observation):
    return 7

def broken(observation):
    raise KeyError("no such joint")

angle = 3.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Files of every kind."""
    folder = tmp_path_factory.mktemp("teachers")
    (folder / "bot_of_a_test.py").write_text(BOT)

    def small(kind, env, **options):
        return kind("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu", seed=0, **options)

    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    small(PPO, env).save(folder / "normalised")
    env.save(folder / "vec.pkl")
    small(PPO, "Pendulum-v1").save(folder / "ppo")
    small(PPO, "CartPole-v1").save(folder / "cartpole")
    small(SAC, "Pendulum-v1", buffer_size=10).save(folder / "sac")
    small(TD3, "Pendulum-v1", buffer_size=10).save(folder / "td3")
    small(DQN, "CartPole-v1", buffer_size=10).save(folder / "dqn")
    for name, network in {
        "logits": nn.Linear(4, 2),
        "action": nn.Linear(3, 1),
        "index": Greedy(),
        "gaussian": Gaussian(),
    }.items():
        torch.jit.script(network).save(folder / f"{name}.pt")
    return folder


class Greedy(nn.Module):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return (observation[:, 2] > 0).long()


class Gaussian(nn.Module):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc = -observation[:, 2:]
        return loc, torch.full_like(loc, 0.5)


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


def given_to(name: str, folder: Path, env: list[str], options: list[str]) -> list[str]:
    path = name if ":" in name else folder / name
    return [*env, f"prior.path={path}", *(option.format(folder=folder) for option in options)]


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


TRUSTED = "prior.trust_code=true"
REFUSED = [
    ("bot_of_a_test:brake", PENDULUM, [], "prior.trust_code=False: expected true, as prior.path=bot_of_a_test:brake"),
    ("action.pt", PENDULUM, ["prior.outputs=[action]"], "prior.trust_code=False: expected true"),
    ("action.pt", PENDULUM, [TRUSTED], "prior.outputs=None: expected [loc,scale], [logits] or [action]"),
    ("action.pt", PENDULUM, [TRUSTED, "prior.outputs=[mean]"], "prior.outputs=['mean']"),
    ("ppo.zip", PENDULUM, ["prior.outputs=[action]"], "prior.outputs=['action']: expected null"),
    ("logits.pt", PENDULUM, [TRUSTED, "prior.outputs=[logits]"], "logits.pt: it can't read observations"),
    ("action.pt", CARTPOLE, [TRUSTED, "prior.outputs=[logits]"], "action.pt: it can't read observations"),
    (
        "gaussian.pt",
        CARTPOLE,
        [TRUSTED, "prior.outputs=[loc,scale]"],
        "gaussian.pt: it advises on actions of shape (2,)",
    ),
    ("ppo.zip", CARTPOLE, [], "ppo.zip: it can't read observations of shape (4,)"),
    ("cartpole.zip", PENDULUM, [], "cartpole.zip: it can't read observations of shape (3,)"),
    ("dqn.zip", CARTPOLE, [], "prior.temperature"),
    ("ppo.zip", PENDULUM, ["prior.vecnormalize=nothing.pkl"], "prior.vecnormalize=nothing.pkl: no such file"),
    (
        "action.pt",
        PENDULUM,
        [TRUSTED, "prior.outputs=[action]", "prior.vecnormalize=a.pkl"],
        "prior.vecnormalize=a.pkl",
    ),
    ("absent.zip", PENDULUM, [], "absent.zip: no such file"),
    ("absent.pt", PENDULUM, [TRUSTED, "prior.outputs=[action]"], "absent.pt: no such file"),
    ("damaged.zip", PENDULUM, [], "damaged.zip"),
    ("damaged.pt", PENDULUM, [TRUSTED, "prior.outputs=[action]"], "damaged.pt: it can't be read as TorchScript"),
    ("no_module_of_mine:act", PENDULUM, [TRUSTED], "no_module_of_mine:act: there is no such module"),
    ("bot_of_a_test:absent", PENDULUM, [TRUSTED], "bot_of_a_test:absent: it can't be imported (AttributeError"),
    ("bot_of_a_test:angle", PENDULUM, [TRUSTED], "bot_of_a_test:angle: expected a function of an observation"),
    ("bot_of_a_test:flat", PENDULUM, [TRUSTED], "bot_of_a_test:flat: it can't read observations"),
    ("bot_of_a_test:whole", CARTPOLE, [TRUSTED], "bot_of_a_test:whole: it can't read observations"),
    ("bot_of_a_test:brake", CARTPOLE, [TRUSTED], "bot_of_a_test:brake: it can't read observations"),
    ("bot_of_a_test:broken", PENDULUM, [TRUSTED], "bot_of_a_test:broken: it fails (KeyError"),
    ("bot_of_a_test:brake", PENDULUM, [TRUSTED, "prior.std=0"], "prior.std=0.0: expected a positive number"),
    ("bot_of_a_test:push", CARTPOLE, [TRUSTED, "prior.epsilon=0"], "prior.epsilon=0.0: expected a probability above 0"),
]


@pytest.mark.usefixtures("_importable")
@pytest.mark.parametrize(("name", "env", "options", "message"), REFUSED)
def test_what_does_not_fit_is_refused_by_key_and_file(name, env, options, message, folder, tmp_path):
    for suffix in ("zip", "pt"):
        (folder / f"damaged.{suffix}").write_bytes(b"PK and no more")
    with pytest.raises(SystemExit, match=r"^Error: ") as error:
        run(tmp_path / "out", *given_to(name, folder, env, options))
    assert message in str(error.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("_importable")
def test_code_is_imported_only_by_who_trusts_it(folder, tmp_path):
    with pytest.raises(SystemExit, match="trust_code"):
        run(tmp_path / "out", *PENDULUM, "prior.path=bot_of_a_test:brake")
    assert "bot_of_a_test" not in sys.modules


@pytest.mark.usefixtures("_importable")
def test_a_figure_of_a_run_runs_no_code_that_the_run_names(folder, tmp_path):
    out = run(tmp_path, *PENDULUM, "prior.path=bot_of_a_test:brake", TRUSTED, "method=ae2r", "total_frames=64")
    del sys.modules["bot_of_a_test"]
    with pytest.raises(ValueError, match="bot_of_a_test:brake is a program"):
        load_agent(out, None)
    assert "bot_of_a_test" not in sys.modules


def test_a_spread_is_asked_for_where_actions_have_no_bounds(tmp_path, monkeypatch):
    class Free(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1, 1, (3,))
        action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(3, np.float32), {}

    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.envs.registration.registry))
    gymnasium.register("Free-v0", Free, disable_env_checker=True)
    (tmp_path / "bot_of_mine.py").write_text(BOT)
    monkeypatch.syspath_prepend(tmp_path)
    options = ["env=any", "env.id=Free-v0", "prior.path=bot_of_mine:brake", TRUSTED, *SHORT]
    with pytest.raises(SystemExit, match=r"prior\.std=None: expected a number"):
        run(tmp_path / "out", *options)
    open_task(config(tmp_path / "out", *options, "prior.std=0.1"))


WORDS = st.sampled_from(
    ["a.zip", "b.pt", "m:f", "os:getcwd", "json:loads", "", "~", "~nobody/x", ":", "a:b:c", "a" * 300]
)
PRIOR = st.fixed_dictionaries(
    {},
    optional={
        "path": st.none() | WORDS | st.text(max_size=6) | st.lists(WORDS | st.integers(), max_size=3) | st.integers(),
        "vecnormalize": st.none() | st.text(max_size=6),
        "outputs": st.none() | st.lists(st.sampled_from(["loc", "scale", "logits", "action", "é"]), max_size=3),
        "std": st.none() | st.floats(allow_nan=True),
        "temperature": st.none() | st.floats(),
        "epsilon": st.floats(),
        "degrade": st.sampled_from(["none", "structural", "random", "reversed", "reverse"]),
    },
)


def refusal(cfg, prior) -> str | None:
    """What a user reads who sets this."""
    try:
        for key, value in prior.items():
            OmegaConf.update(cfg, f"prior.{key}", value)
        open_task(cfg)
    except (OmegaConfBaseException, ValueError, OSError) as error:
        return str(error)
    return None


@settings(max_examples=150)
@given(PRIOR, st.sampled_from([CARTPOLE, PENDULUM]))
def test_any_value_of_the_new_keys_is_fine_or_refused_by_name(prior, env):
    message = refusal(FUZZED[env[1]].copy(), prior)
    assert message is None or any(f"prior.{key}" in message for key in ("trust_code", *prior))


FUZZED = {env[1]: config(Path("unused"), *env) for env in (CARTPOLE, PENDULUM)}


@settings(max_examples=40)
@given(st.data())
def test_a_damaged_file_is_refused_by_its_name(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "damage"
    if not folder.exists():
        folder.mkdir()
        PPO("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [4]}, device="cpu").save(folder / "whole")
        torch.jit.script(nn.Linear(4, 2)).save(folder / "whole.pt")
    kind = data.draw(st.sampled_from(["zip", "pt"]))
    content = bytearray((folder / f"whole.{kind}").read_bytes())
    cut = data.draw(st.integers(0, len(content) - 1))
    file = folder / f"cut.{kind}"
    file.write_bytes(content[:cut])
    options = [] if kind == "zip" else ["prior.outputs=[logits]", TRUSTED]
    cfg = config(folder, *CARTPOLE, f"prior.path={file}", *options, "method=e2r")
    with pytest.raises(ValueError, match=rf"prior\.path=.*cut\.{kind}"):
        open_task(cfg)
