"""Any value of any key of a recipe's configuration is either fine or refused by an error that names the key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from recipes.gridworld import config as gridworld_config
from recipes.mujoco import task
from recipes.report import config as report_config

ROOT = Path(__file__).parents[2]
CHECKS: dict[str, Callable[[Any], None]] = {
    "gridworld": gridworld_config.check,
    "mujoco": task.open_task,
    "report": report_config.check,
}
REQUIRED = {"report": ["runs=outputs"]}


def composed(name: str, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose(name, overrides=[*REQUIRED.get(name, []), *overrides])


def keys_of(node: Any, prefix: str = "") -> list[str]:
    if isinstance(node, DictConfig):
        return [key for name in node for key in keys_of(node._get_node(name), f"{prefix}{name}.")]
    return [prefix[:-1]]


CONFIGS = {name: composed(name) for name in CHECKS}

KEYS = [(name, key) for name, config in CONFIGS.items() for key in keys_of(config)]
NUMBERS = st.sampled_from([0, 1, -1, 3, 2**31, 2**63, 10**30, 0.5, -0.5, 1e-300, 1e308, "nan", "inf", "-inf", "1e400"])
WORDS = st.sampled_from(
    ["", "none", "null", "original", "ae2r", "cpu", "cuda:99", "meta", "tpu", "true", "é☃", "a" * 300]
)
VALUES = NUMBERS | WORDS | st.none() | st.booleans() | st.text(max_size=8) | st.lists(NUMBERS | WORDS, max_size=3)


def refusal(name: str, key: str, value: Any) -> str | None:
    """What a user reads who sets this; other errors than those that are shown without a traceback pass through."""
    config = CONFIGS[name].copy()
    try:
        OmegaConf.update(config, key, value)
        CHECKS[name](config)
    except (OmegaConfBaseException, ValueError, OSError) as error:
        return str(error)
    return None


@settings(max_examples=1000)
@given(st.sampled_from(KEYS), VALUES)
@example(("gridworld", "device"), "")
@example(("gridworld", "priors"), ["random_" + "9" * 5000])
@example(("mujoco", "ppo.hidden"), [])
@example(("mujoco", "method"), "")
@example(("mujoco", "prior.path"), "a" * 300)
def test_a_value_is_fine_or_refused_by_its_key(where: tuple[str, str], value: Any) -> None:
    name, key = where
    message = refusal(name, key, value)
    if message is not None:
        # env.version, say, is part of env=Hopper-v0, and env.degrade_threshold is read as prior.threshold
        assert any(part in message for part in key.replace("degrade_", "prior.").split("."))


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("gridworld", "device", "meta"),  # a device that computes nothing
        ("gridworld", "device", "cuda:99"),
        ("gridworld", "student.gamma", "nan"),
        ("gridworld", "methods", ["none", "none"]),
        ("mujoco", "ppo.gamma", 1.5),
        ("mujoco", "method", "ae2"),
        ("mujoco", "weight.init_bias", "nan"),
        ("mujoco", "prior.threshold", "nan"),
        ("mujoco", "env.version", "v0"),
        ("report", "pairing", "none"),
        ("report", "bootstrap.confidence", 1),
    ],
)
def test_what_would_mean_nothing_is_refused(name: str, key: str, value: Any) -> None:
    message = refusal(name, key, value)
    assert message is not None
    assert any(part in message for part in key.split("."))


@pytest.mark.parametrize("name", CHECKS)
@pytest.mark.parametrize(
    "typo",
    ["sed=1", "student.lrr=0.1", "ppo.epoch=3", "env=nothing", "bootstrap=3", "a=b=c", "=", "seed=[", "~all"],
)
def test_a_typo_is_refused_by_hydra(name: str, typo: str) -> None:
    with pytest.raises(HydraException):
        composed(name, typo)


@pytest.mark.parametrize("name", CHECKS)
def test_the_defaults_of_every_recipe_are_accepted(name: str) -> None:
    CHECKS[name](CONFIGS[name])
    assert not isinstance(CONFIGS[name], ListConfig)
