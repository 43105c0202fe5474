"""Jobs of a cluster that takes machines away: they save themselves, and go on when they come out of the queue again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("submitit")
from mujoco_cases import ROOT, TINY, run
from sweep_cases import at_work, results, wait_for


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="it asks Linux for the process of a run")
def test_a_job_that_is_taken_away_is_saved_queued_again_and_gives_the_same_result(tmp_path: Path) -> None:
    out, long = tmp_path / "sweep", ["total_frames=1280", "checkpoint.interval=100000"]
    command = [sys.executable, "-m", "recipes.mujoco", "-m", "hydra/launcher=submitit_local", *TINY, *long, "seed=0,1"]
    command += [f"out={out}/${{seed}}", f"hydra.sweep.dir={tmp_path}/said"]
    sweep = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signals = {"0": signal.SIGTERM, "1": signal.SIGUSR2}  # Slurm's first, and that by which submitit queues a job again

    def send() -> bool:
        for process, folder in at_work(out, "eval.csv").items():
            if number := signals.pop(folder.name, None):
                os.kill(process, number)
        return not signals

    wait_for(send, sweep)
    output, errors = sweep.communicate()
    assert sweep.returncode == 0, errors
    assert "Sweep: 2 of 2 runs are done, 0 failed." in output
    logs = [file.read_text() for file in sorted((tmp_path / "said").rglob("*_log.*"))]
    for words in ("asked to stop, saved at", "Requeued job"):
        assert sum(words in log for log in logs) == 2
    for seed in range(2):
        assert results(out / str(seed)) == results(run(tmp_path / f"alone-{seed}", *long, f"seed={seed}"))
