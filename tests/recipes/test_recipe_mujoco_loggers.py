"""The loggers of the MuJoCo recipe: what they hold after a run, and after one that was interrupted."""

from __future__ import annotations

import importlib.util

import pandas as pd
import pytest

pytest.importorskip("mujoco")
from mujoco_cases import interrupt, run

pytestmark = pytest.mark.usefixtures("without_torchrls_groups")


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    return run(tmp_path_factory.mktemp("teacher"), "total_frames=64") / "policy.safetensors"


@pytest.mark.parametrize("interval", [128, 256])  # after the checkpoint at 128, or before there is one
def test_tensorboard_has_every_point_once_although_the_run_was_interrupted(teacher, tmp_path, monkeypatch, interval):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    options = ["logger=tensorboard", "method=ae2r", f"prior.path={teacher}", f"checkpoint.interval={interval}"]
    interrupt(monkeypatch, tmp_path, 192, *options)  # 192 is logged twice
    run(tmp_path, *options)
    found = events.EventAccumulator(str(tmp_path / "log"), size_guidance={"scalars": 0, "histograms": 0}).Reload()
    for prefix, table in (("train", "metrics"), ("eval", "eval")):
        rows = pd.read_csv(tmp_path / f"{table}.csv").set_index("frames")
        for name, column in rows.items():
            points = {point.step: point.value for point in found.Scalars(f"{prefix}/{name}")}
            assert len(points) == len(found.Scalars(f"{prefix}/{name}"))
            assert points == pytest.approx(column.dropna().to_dict(), rel=1e-5)
    assert [point.step for point in found.Histograms("train/prior_weights")] == [64, 128, 192, 256]


def test_wandb_offline_continues_the_same_run(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    interrupt(monkeypatch, tmp_path, 192, "logger=wandb")
    run(tmp_path, "logger=wandb")
    logs = list((tmp_path / "log").glob("wandb/offline-run-*/run-*.wandb"))
    assert len(logs) >= 1
    assert len({log.name for log in logs}) == 1


def test_a_logger_whose_package_is_missing_is_refused_by_the_name_of_its_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *args: None)
    with pytest.raises(SystemExit, match=r"logger=tensorboard.*pip install 'torchrl-priors\[tensorboard\]'"):
        run(tmp_path / "out", "logger=tensorboard")
    assert not (tmp_path / "out").exists()
