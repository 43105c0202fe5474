"""Every recipe's command line: what ``--help`` says, and what is said where a key is missing or ``out`` is a folder."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from recipes.common.sweeps import start
from torchrl_priors.methods import METHODS

pytest.importorskip("mujoco")

ROOT = Path(__file__).parents[2]
REQUIRED = {
    "report": ["runs"],
    "export_best": ["runs", "env_id", "out"],
    "export_sb3": ["model", "env_id", "out"],
    "show_weight": ["run"],
    "gridworld": [],
    "mujoco": [],
}
PACKAGES = {"report", "show_weight", "gridworld", "mujoco", "mujoco_study"}
MAINS = {
    name: importlib.import_module(f"recipes.{name}.__main__" if name in PACKAGES else f"recipes.{name}").main
    for name in (*REQUIRED, "mujoco_study")
}
Recipe = Callable[..., str]

pytestmark = pytest.mark.usefixtures("without_torchrls_groups")


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Recipe:
    """Run a recipe as its command does; what it said before it ended."""

    def run(name: str, *arguments: str) -> str:
        monkeypatch.chdir(ROOT)
        monkeypatch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        try:
            start(MAINS[name], name)
        except SystemExit as end:
            if end.code:
                return str(end.code)
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize("name", MAINS)
def test_help_says_what_a_recipe_does_and_what_each_key_means(name: str, recipe: Recipe) -> None:
    said = recipe(name, "--help")
    text = (ROOT / "conf" / f"{name}.yaml").read_text()
    assert said.startswith(text[2:].split(".")[0])  # the YAML's own first line
    assert f"python -m recipes.{name}" in said
    assert all(f"\n{key}: ???  # " in said for key in REQUIRED.get(name, []))
    assert "schema" not in said
    assert "hydra" not in said
    for comment in re.findall("#.*", text.partition("\n\n")[2]):
        assert re.sub(r"# (\w+: )?", "", comment, count=1) in said
    assert recipe(name, "method=er", "-h") == said


@pytest.mark.parametrize(
    ("name", "group"), [("gridworld", "study"), ("mujoco", "env"), ("mujoco_study", "study_mujoco")]
)
def test_help_lists_what_there_is_to_choose_from(name: str, group: str, recipe: Recipe) -> None:
    said = recipe(name, "--help")
    for file in (ROOT / "conf" / group).glob("*.yaml"):
        assert f"{group}={file.stem}" in said
    if name != "mujoco_study":
        assert f"Methods: {', '.join(METHODS)}" in said
        assert ("worlds: 1000" if name == "gridworld" else "num_envs: 2") in said


@pytest.mark.parametrize("name", [name for name, keys in REQUIRED.items() if keys])
def test_keys_that_were_forgotten_are_named_together(name: str, recipe: Recipe) -> None:
    said = recipe(name)
    assert said.startswith("Error: ")
    assert all(f"{key}=" in said for key in REQUIRED[name])
    given = [f"{key}=x" for key in REQUIRED[name]]
    assert "expected a value" not in recipe(name, *given)


def test_a_value_that_was_taken_away_is_named(recipe: Recipe) -> None:
    assert "ppo.lr=: expected a value" in recipe("mujoco", "ppo.lr=???")
    assert "student.lr=: expected a value" in recipe("gridworld", "student.lr=???")


@pytest.mark.parametrize("name", ["export_best", "export_sb3"])
def test_a_folder_where_a_file_is_to_be_written_is_refused(name: str, recipe: Recipe, tmp_path: Path) -> None:
    given = [f"{key}={tmp_path}" for key in REQUIRED[name]]
    assert recipe(name, *given) == f"Error: out={tmp_path}: this is a folder, expected the name of the file to write."
    assert not list(tmp_path.iterdir())
