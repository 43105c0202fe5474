"""The commands of the benchmarks run as the README has them, at the smallest sizes."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
SMALL = ["compile=false", "ppo.hidden=[8]", "ppo.epochs=1", "env.num_envs=2", "env.frames_per_batch=64"]
SMALL += ["env.minibatch_size=32", "evaluation.episodes=2"]


def test_the_continuous_benchmark_runs() -> None:
    found = re.search(r"`python (benchmarks/continuous\.py[^`]*)`", (ROOT / "README.md").read_text())
    assert found is not None
    arguments = shlex.split(found[1])
    assert "--rounds" in arguments
    command = [sys.executable, *arguments, "--rounds", "1", "--rollouts", "1", "--methods", "ae2r", *SMALL]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for line in ("first rollout of ae2r", "train    stable-baselines3", "ae2r / none, training", "TorchRL's Collector"):
        assert line in done.stdout, done.stdout


def test_the_gridworld_benchmark_runs() -> None:
    assert "`python benchmarks/gridworld.py`" in (ROOT / "README.md").read_text()
    command = [sys.executable, "benchmarks/gridworld.py", "--worlds", "1", "--rounds", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for line in ("worlds per CPU second", "ae2r", "the paper's table", "GiB"):
        assert line in done.stdout, done.stdout
