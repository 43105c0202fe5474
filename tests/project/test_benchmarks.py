"""The commands of the benchmarks run as benchmarks/README.md has them, at the smallest sizes."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALL = ["compile=false", "ppo.hidden=[8]", "ppo.epochs=1", "env.num_envs=2", "env.frames_per_batch=64"]
SMALL += ["env.minibatch_size=32", "evaluation.episodes=2"]


def run(*command: str) -> None:
    """Run a script in this process, from the repository's root; an error of it is one here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(sys, "argv", [*command])
        runpy.run_path(str(ROOT / command[0]), run_name="__main__")


def test_the_continuous_benchmark_runs(capfd: pytest.CaptureFixture[str]) -> None:
    found = re.search(r"`python (benchmarks/continuous\.py[^`]*)`", (ROOT / "benchmarks/README.md").read_text())
    assert found is not None
    arguments = shlex.split(found[1])
    assert "--rounds" in arguments
    run(*arguments, "--rounds", "1", "--rollouts", "1", "--methods", "ae2r", *SMALL)
    said = capfd.readouterr().out
    for line in ("first rollout of ae2r", "train    stable-baselines3", "ae2r / none, training", "TorchRL's Collector"):
        assert line in said, said


def test_the_gridworld_benchmark_runs(capfd: pytest.CaptureFixture[str]) -> None:
    assert "`python benchmarks/gridworld.py`" in (ROOT / "benchmarks/README.md").read_text()
    run("benchmarks/gridworld.py", "--worlds", "1", "--rounds", "1")
    said = capfd.readouterr().out
    for line in ("worlds per CPU second", "ae2r", "the paper's table", "GiB"):
        assert line in said, said
