"""Sweeps by Ray: runs side by side, on this machine or a cluster, of which none is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("ray")
pytest.importorskip("mujoco")
import ray
from mujoco_cases import ROOT, TINY, run
from sweep_cases import at_work, done, results, start_sweep, sweep, wait_for

#: Where a run is that has one to go on from.
CHECKPOINT = "checkpoints/*.sha256.json"


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A Ray that several sweeps use; its address."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        ray.init(address="local", num_cpus=2, include_dashboard=False, object_store_memory=80 * 2**20)
        yield ray.get_runtime_context().gcs_address
        ray.shutdown()


def test_a_run_that_raises_does_not_stop_the_others(cluster: str, tmp_path: Path) -> None:
    result, ended = sweep(tmp_path, "seed=range(3)", "raises=0", f"hydra.launcher.address={cluster}")
    assert list(ended) == ["1", "2"]
    assert result.returncode != 0
    assert "seed 0 is broken" in result.stderr


def test_runs_that_fail_or_die_again_and_again_are_listed_and_the_others_end(cluster: str, tmp_path: Path) -> None:
    ways = [f"hydra.launcher.address={cluster}", "hydra.launcher.max_retries=0"]
    result, ended = sweep(tmp_path, "seed=range(4)", "fails=0", "dies=1", *ways)
    assert list(ended) == ["2", "3"]
    assert {threads for _, threads in ended.values()} == {"1"}
    assert result.returncode == 1
    assert "Sweep: 2 of 4 runs are done, 2 failed." in result.stdout
    assert "Failed: seed=0: Error: it failed" in result.stderr
    assert "Failed: seed=1: Error: Ray lost the run (WorkerCrashedError, max_retries=0)" in result.stderr


def test_ctrl_c_ends_the_runs_and_says_how_to_go_on(cluster: str, tmp_path: Path) -> None:
    process = start_sweep(tmp_path, "seed=range(4)", "lasts=600", f"hydra.launcher.address={cluster}")
    wait_for(lambda: len(done(tmp_path)) == 2, process)
    os.killpg(process.pid, signal.SIGINT)  # Ctrl-C reaches all processes of the terminal
    said = [line for line in process.communicate()[1].splitlines() if "raylet" not in line]
    assert said[-1:] == ["Interrupted: the same command continues."]
    assert "Traceback" not in "".join(said)
    assert process.returncode == 130
    deadline = time.monotonic() + 60
    while any(Path(f"/proc/{number}").exists() for number, _ in done(tmp_path).values()):
        assert time.monotonic() < deadline, "its runs go on"
        time.sleep(0.02)
    assert len(done(tmp_path)) == 2


def kill_one(out: Path) -> bool:
    """End a run that is not finished by force."""
    for process, folder in at_work(out, CHECKPOINT).items():
        try:
            os.kill(process, signal.SIGSTOP)
            running = json.loads((folder / "status.json").read_text())["state"] == "running"
            os.kill(process, signal.SIGKILL if running else signal.SIGCONT)
        except ProcessLookupError:
            continue
        if running:
            return True
    return False


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="it asks Linux for the process of a run")
def test_a_sweep_with_a_run_that_is_killed_gives_what_single_runs_give(tmp_path: Path) -> None:
    out, short = tmp_path / "sweep", ["total_frames=192", "ppo.epochs=1", "checkpoint.interval=64"]
    command = [sys.executable, "-m", "recipes.mujoco", "-m", "hydra/launcher=ray", *TINY, *short, "seed=range(8)"]
    command += [f"out={out}/${{seed}}", f"hydra.sweep.dir={tmp_path}/said"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: kill_one(out), process)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "Sweep: 8 of 8 runs are done, 0 failed." in output
    for seed in range(8):
        alone = run(tmp_path / f"alone-{seed}", *short, f"seed={seed}", recorded=True)
        assert results(out / str(seed)) == results(alone)
