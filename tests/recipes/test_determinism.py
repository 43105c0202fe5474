"""The same seed gives the same bits in another process, whatever the hash seed of Python is."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MUJOCO = ["env.num_envs=2", "env.frames_per_batch=64", "env.minibatch_size=32", "total_frames=128", "ppo.epochs=1"]
MUJOCO += ["ppo.hidden=[8]", "evaluation.interval=64", "evaluation.episodes=2", "checkpoint.interval=128"]
MUJOCO += ["compile=false", "seed=3"]
GRIDWORLD = ["worlds=3", "methods=[none,ae2r,aligned]", "priors=[random_30]"]
GRIDWORLD += ["teacher.steps=300", "teacher.eval_episodes=2", "evaluation.points=4", "evaluation.interval=20"]
GRIDWORLD += ["bootstrap.reps=20", "seed=3"]


def run_here(recipe: str, *arguments: str) -> None:
    """Run a recipe in this process, which has done other things before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setenv("HYDRA_MAIN_MODULE", "__main__")  # find conf/ as the command does
        patch.setattr(sys, "argv", [recipe, *arguments])
        importlib.import_module(f"recipes.{recipe}.__main__").main()


def run_elsewhere(recipe: str, *arguments: str) -> None:
    """Run it in a fresh process, with another hash seed than this one has."""
    hash_seed = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    command = [sys.executable, "-m", f"recipes.{recipe}", *arguments]
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def files(out: Path) -> dict[str, bytes]:
    """What is told to be reproducible: tables and policies, no times and no pictures."""
    kept = [path for path in out.glob("*") if path.suffix in (".csv", ".safetensors", ".npz")]
    return {path.name: path.read_bytes() for path in kept if path.name != "metrics.csv"}  # has frames per second


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(("recipe", "overrides"), [("mujoco", MUJOCO), ("gridworld", GRIDWORLD)])
def test_two_processes_write_the_same_bytes(recipe: str, overrides: list[str], tmp_path: Path) -> None:
    if recipe == "mujoco":
        pytest.importorskip("mujoco")
    run_here(recipe, *overrides, f"out={tmp_path / 'here'}")
    run_elsewhere(recipe, *overrides, f"out={tmp_path / 'elsewhere'}")
    first, second = files(tmp_path / "here"), files(tmp_path / "elsewhere")
    assert {"eval.csv", "policy.safetensors"} <= first.keys() or {"area_ratio.csv", "worlds.csv"} <= first.keys()
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
