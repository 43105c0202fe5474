"""What ``prior.path`` and the keys beside it refuse, by the name of the key or the file."""

from __future__ import annotations

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
from torch import nn

pytest.importorskip("mujoco")
pytest.importorskip("stable_baselines3")
from mujoco_cases import config, run
from own_teacher_cases import BOT, CARTPOLE, PENDULUM, SHORT, TRUSTED, given_to, write_teachers
from stable_baselines3 import PPO

from recipes.mujoco.task import open_task
from recipes.show_weight.episode import load_agent


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
    cfg = config(folder, *CARTPOLE, "prior.path=cut", *options, "method=e2r")
    cfg.prior.path = str(file)
    with pytest.raises(ValueError, match=rf"prior\.path=.*cut\.{kind}"):
        open_task(cfg)
