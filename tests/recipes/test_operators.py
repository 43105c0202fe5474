"""What those who operate runs do: stop them, run out of things, let them go on for longer, read their logs."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("mujoco")
from mujoco_cases import TINY, run

from recipes.common.progress import progress_bar
from recipes.common.sweeps import start
from recipes.mujoco import __main__ as mujoco
from recipes.mujoco import config as mujoco_config
from recipes.mujoco import run as mujoco_run
from recipes.report.runs import find, read


def stop_at(monkeypatch: pytest.MonkeyPatch, frames: int, how) -> None:
    """Do something when a rollout has been logged."""
    log = mujoco_run.Run.log

    def stopping(self, at, *args, **kwargs):
        log(self, at, *args, **kwargs)
        if at == frames:
            how()

    monkeypatch.setattr(mujoco_run.Run, "log", stopping)


def interrupt() -> None:
    """Ctrl-C."""
    raise KeyboardInterrupt


def terminate() -> None:
    """What a cluster sends before it takes the machine away."""
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that nobody stopped."""
    return run(tmp_path_factory.mktemp("whole"), "checkpoint.interval=1000")


@pytest.mark.parametrize(
    ("how", "code", "saved"), [(interrupt, 130, 0), (terminate, 143, 192)], ids=["ctrl-c", "sigterm"]
)
def test_a_stopped_run_says_so_in_a_line_and_is_continued(how, code, saved, whole, tmp_path, monkeypatch, capsys):
    before = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        stop_at(patch, 192, how)
        with pytest.raises(SystemExit) as end:
            run(tmp_path, "checkpoint.interval=1000")
    assert end.value.code == code
    assert signal.getsignal(signal.SIGTERM) == before
    said = [line for line in capsys.readouterr().err.splitlines() if "frame/s" not in line]
    assert len(said) == 1
    assert said[0].endswith("the same command continues.")
    assert json.loads((tmp_path / "status.json").read_text()) == {"state": "interrupted", "frames": 192}
    assert len([*tmp_path.glob("checkpoints/checkpoint-*[0-9]")]) == (saved > 0)
    (left_out,) = read(find(str(tmp_path)))[1]
    assert left_out.reason == "it is not finished: broken off after 192 frames, and continued by the same command"
    run(tmp_path, "checkpoint.interval=1000")
    for name in ("eval.csv", "policy.safetensors"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_a_finished_run_goes_on_for_more_frames(whole, tmp_path, capsys):
    run(tmp_path, "total_frames=128")
    run(tmp_path, "total_frames=256")
    assert (tmp_path / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()
    assert pd.read_csv(tmp_path / "eval.csv").equals(pd.read_csv(whole / "eval.csv"))
    with pytest.raises(SystemExit, match=r"total_frames: 256 -> 128"):
        run(tmp_path, "total_frames=128")


def test_a_run_whose_schedule_has_an_end_does_not(whole, tmp_path):
    taught = ["method=annealed_kickstart", f"prior.path={whole / 'policy.safetensors'}"]
    run(tmp_path, *taught, "total_frames=128")
    with pytest.raises(SystemExit, match=r"total_frames: 128 -> 256"):
        run(tmp_path, *taught, "total_frames=256")


def test_a_home_directory_may_be_written_short(whole, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "teacher.safetensors").write_bytes((whole / "policy.safetensors").read_bytes())
    command = [*TINY, "out=~/run", "method=kickstart", "prior.path=~/teacher.safetensors", "total_frames=64"]
    monkeypatch.setattr(sys, "argv", ["mujoco", *command])
    monkeypatch.setenv("HYDRA_MAIN_MODULE", "__main__")
    start(mujoco.main, "mujoco")
    assert (tmp_path / "run/eval.csv").exists()


def test_what_saves_the_policy_is_missed_before_training(tmp_path, monkeypatch):
    monkeypatch.setattr(mujoco_config, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"safetensors.* is missing.*: pip install"):
        run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_log_has_lines_and_no_line_written_over(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    with progress_bar(total=100, desc="learning") as bar:
        for _ in range(100):
            bar.update()
    assert "\r" not in log.getvalue()
    assert 1 <= len(log.getvalue().splitlines()) <= 3  # not one a step
    assert "100/100" in log.getvalue().splitlines()[-1]
