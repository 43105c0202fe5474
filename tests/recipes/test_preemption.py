"""Jobs of a cluster that takes machines away: they save themselves, and go on when they come out of the queue again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("submitit")
from mujoco_cases import ROOT, TINY, run
from sweep_cases import at_work, results, wait_for

from recipes.common.preemption import Notice


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="it asks Linux for the process of a run")
def test_a_job_that_is_taken_away_is_saved_queued_again_and_gives_the_same_result(tmp_path: Path) -> None:
    out, long = tmp_path / "sweep", ["total_frames=640", "checkpoint.interval=100000"]
    command = [sys.executable, "-m", "recipes.mujoco", "-m", "hydra/launcher=submitit_local", *TINY, *long]
    command += [f"out={out}/${{seed}}", f"hydra.sweep.dir={tmp_path}/said"]
    sweep = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def send() -> bool:
        at = at_work(out, "eval.csv")
        for process in at:
            os.kill(process, signal.SIGTERM)  # Slurm's first
        return bool(at)

    wait_for(send, sweep)
    output, errors = sweep.communicate()
    assert sweep.returncode == 0, errors
    assert "Sweep: 1 of 1 runs are done, 0 failed." in output
    said = "".join(file.read_text() for file in (tmp_path / "said").rglob("*_log.*"))
    for words in ("asked to stop, saved at", "Requeued job"):
        assert words in said
    assert results(out / "0") == results(run(tmp_path / "alone", *long, recorded=True))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR2])
def test_either_signal_is_heeded_and_the_queue_has_the_last_word(number: int) -> None:
    stopped, queued = Mock(), Mock()
    before = signal.getsignal(signal.SIGTERM), signal.signal(signal.SIGUSR2, queued)
    try:
        notice = Notice(stopped)
        os.kill(os.getpid(), number)
        stopped.assert_called_once()
        queued.assert_not_called()
        with pytest.raises(SystemExit):
            notice.leave(143)
        queued.assert_called_once_with(signal.SIGUSR2, None)
        assert signal.getsignal(signal.SIGTERM) == before[0]
    finally:
        signal.signal(signal.SIGUSR2, before[1])


def test_a_signal_that_nobody_would_queue_by_is_left_alone() -> None:
    before = signal.getsignal(signal.SIGUSR2)
    notice = Notice(Mock())
    assert signal.getsignal(signal.SIGUSR2) == before
    notice.release()
