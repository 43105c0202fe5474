"""Folders of runs that come from elsewhere: nothing in them runs, or tells what the machine keeps to itself."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from report_cases import write_run
from tensordict import NonTensorData, TensorDict

from recipes.common.run_folder import refuse_foreign
from recipes.report.runs import read


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


@pytest.fixture(scope="module")
def mujoco_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a learned weight, and two checkpoints."""
    pytest.importorskip("mujoco")
    from mujoco_cases import run

    folder = tmp_path_factory.mktemp("mujoco")
    run(folder / "teacher")
    return run(folder / "run", "method=ae2r", f"prior.path={folder}/teacher/policy.safetensors")


@pytest.fixture
def received(mujoco_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(mujoco_run, tmp_path / "run"))


def newest(run: Path) -> Path:
    return max(path for path in (run / "checkpoints").iterdir() if path.is_dir())


def put_pickle(run: Path, ran: Path) -> None:
    """An entry of the agent's state whose content is in a pickle, as tensordict keeps what is no tensor."""
    state = next(newest(run).glob("components/*agent/state"))
    entry = TensorDict(x=NonTensorData("text"))
    entry.memmap(run / "entry")
    shutil.move(run / "entry" / "x", state / "x")
    (state / "x" / "other.pickle").write_bytes(pickle.dumps(Bomb(ran)))
    listing, other = (json.loads((at / "meta.json").read_text()) for at in (state, run / "entry"))
    (state / "meta.json").write_text(json.dumps({**listing, "x": other["x"]}))


def put_torch(run: Path, ran: Path) -> None:
    torch.save({}, newest(run) / "state.pt")


def put_link(run: Path, ran: Path) -> None:
    (newest(run) / "more.json").symlink_to("/etc/hostname")


def pack(run: Path, ran: Path) -> None:
    put_pickle(run, ran)
    folder = newest(run)
    with zipfile.ZipFile(folder.with_suffix(".torchrl"), "w") as archive:
        for file in folder.rglob("*.*"):
            archive.write(file, file.relative_to(folder))
    shutil.rmtree(folder)


@pytest.mark.filterwarnings("ignore:TensorDict.load_memmap is loading a pickled")
@pytest.mark.parametrize("spoil", [put_pickle, put_torch, put_link, pack])
def test_a_checkpoint_with_other_files_than_json_and_arrays_is_not_loaded(
    received: Path, tmp_path: Path, spoil: Callable[[Path, Path], None]
) -> None:
    from mujoco_cases import config

    from recipes.mujoco import train
    from recipes.show_weight.episode import load_agent

    spoil(received, tmp_path / "ran")
    with pytest.raises(ValueError, match="is not loaded: a checkpoint is a folder"):
        load_agent(received, None)
    (received / "status.json").unlink()
    teacher = OmegaConf.load(received / "config.yaml").prior.path
    with pytest.raises(SystemExit, match="is not loaded: a checkpoint is a folder"):
        train.run(config(received, "method=ae2r", f"prior.path={teacher}"))
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_of_ones_own_is_loaded(received: Path) -> None:
    from recipes.show_weight.episode import load_agent

    refuse_foreign(newest(received))
    assert load_agent(received, None)[1].env_id == "Hopper-v5"


def test_an_environment_that_names_a_module_is_not_shown(
    received: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from recipes.show_weight.episode import load_agent

    (tmp_path / "foreign_module.py").write_text("raise AssertionError('it was imported')")
    monkeypatch.syspath_prepend(tmp_path)
    cfg = OmegaConf.load(received / "config.yaml")
    cfg.env.id = "foreign_module:Hopper"
    OmegaConf.save(cfg, received / "config.yaml")
    with pytest.raises(ValueError, match="'foreign_module:Hopper-v5': an environment that names a module"):
        load_agent(received, None)
    assert "foreign_module" not in sys.modules


def test_a_report_shows_what_a_run_says_of_variables_of_the_machine_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET_OF_MINE", "hunter2")
    config = {"weight": {"lr_coeff": "${oc.env:SECRET_OF_MINE}"}}
    folder = write_run(tmp_path / "run", method="none", config=config)
    (run,), left_out = read([folder])
    assert left_out == []
    assert run.settings["weight.lr_coeff"] == "${oc.env:SECRET_OF_MINE}"
