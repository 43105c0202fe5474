"""Sweeps by Ray: runs side by side, on this machine or a cluster, of which none is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("ray")
pytest.importorskip("mujoco")
import ray
from mujoco_cases import ROOT, TINY, run
from sweep_cases import at_work, results, sweep, wait_for

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


def test_runs_are_processes_of_one_thread_and_one_that_raises_does_not_stop_the_others(
    cluster: str, tmp_path: Path
) -> None:
    result, done = sweep(tmp_path, "seed=range(4)", "raises=0", f"hydra.launcher.address={cluster}")
    assert list(done) == ["1", "2", "3"]
    assert result.returncode != 0
    assert "seed 0 is broken" in result.stderr
    assert {threads for _, threads in done.values()} == {"1"}


def test_runs_that_fail_or_die_again_and_again_are_listed_and_the_others_end(cluster: str, tmp_path: Path) -> None:
    ways = [f"hydra.launcher.address={cluster}", "hydra.launcher.max_retries=0"]
    result, done = sweep(tmp_path, "seed=range(4)", "fails=0", "dies=1", *ways)
    assert list(done) == ["2", "3"]
    assert result.returncode == 1
    assert "Sweep: 2 of 4 runs are done, 2 failed." in result.stdout
    assert "Failed: seed=0: Error: it failed" in result.stderr
    assert "Failed: seed=1: Error: Ray lost the run (WorkerCrashedError, max_retries=0)" in result.stderr


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
def test_a_sweep_that_is_interrupted_and_whose_run_is_killed_gives_what_single_runs_give(tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    command = [sys.executable, "-m", "recipes.mujoco", "-m", "hydra/launcher=ray", *TINY, "seed=range(8)"]
    command += [f"out={out}/${{seed}}", f"hydra.sweep.dir={tmp_path}/said"]

    def start() -> subprocess.Popen:
        pipe = subprocess.PIPE
        # a job in the background of a shell ignores Ctrl-C, and what it starts does so too
        heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
        return subprocess.Popen(
            command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=True, preexec_fn=heed
        )

    first = start()
    wait_for(lambda: at_work(out, CHECKPOINT), first)
    os.killpg(first.pid, signal.SIGINT)  # Ctrl-C reaches all processes of the terminal
    said = [line for line in first.communicate()[1].splitlines() if "raylet" not in line]
    assert said[-1:] == ["Interrupted: the same command continues."]
    assert "Traceback" not in "".join(said)
    assert first.returncode == 130

    second = start()
    wait_for(lambda: kill_one(out), second)
    output, errors = second.communicate()
    assert second.returncode == 0, errors
    assert "Sweep: 8 of 8 runs are done, 0 failed." in output
    for seed in range(8):
        alone = run(tmp_path / f"alone-{seed}", f"seed={seed}")
        assert results(out / str(seed)) == results(alone)
