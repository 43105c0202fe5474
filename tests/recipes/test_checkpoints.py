"""Checkpoints that were damaged: the older one is used, or the run is refused by name; none is used silently."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
from mujoco_cases import interrupt, run

from recipes.common import checkpoints as module
from recipes.common.checkpoints import Checkpoints


@pytest.fixture(scope="module")
def stopped(tmp_path_factory) -> Path:
    """A run that was broken off after its checkpoints at 64 and 128 of 256 frames."""
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, folder / "run", 192)
    shutil.copytree(folder / "run", folder / "whole")
    run(folder / "whole")
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, folder / "other", 192, "seed=1")
    return folder


@pytest.fixture
def broken_off(stopped, tmp_path) -> Path:
    return Path(shutil.copytree(stopped / "run", tmp_path / "run"))


def newest(folder: Path) -> Path:
    return max(path for path in (folder / "checkpoints").iterdir() if path.is_dir())


def cut(file: Path, chance: random.Random) -> None:
    file.write_bytes(file.read_bytes()[: chance.randrange(file.stat().st_size)])


def flip(file: Path, chance: random.Random) -> None:
    content = bytearray(file.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    file.write_bytes(content)


def empty(file: Path, chance: random.Random) -> None:
    file.write_bytes(b"")


def remove(file: Path, chance: random.Random) -> None:
    file.unlink()


def files_of(checkpoint: Path) -> list[Path]:
    return sorted(file for file in checkpoint.rglob("*") if file.is_file() and file.stat().st_size)


@pytest.mark.parametrize("damage", [cut, flip, empty, remove])
def test_every_damage_is_seen_and_the_older_one_is_named_instead(damage, broken_off, capsys):
    chance = random.Random(0)
    store = Checkpoints(broken_off / "checkpoints", 2, identity_of(broken_off))
    whole, older = newest(broken_off), sorted(broken_off.glob("checkpoints/checkpoint-*64"))[0]
    names = [file.relative_to(whole) for file in files_of(whole)]
    for name in chance.sample(names, 25):
        content = (whole / name).read_bytes()
        damage(whole / name, chance)
        assert store.newest() == older
        said = capsys.readouterr().err
        assert str(whole / name) in said
        assert f"going on from {older.name}" in said
        (whole / name).write_bytes(content)
    assert store.newest() == whole


def identity_of(folder: Path) -> str:
    import json

    return str(json.loads(next(folder.glob("checkpoints/*.sha256.json")).read_text())["run"])


def test_a_run_goes_on_from_the_older_one_to_the_same_end(broken_off, stopped, capsys):
    largest = max(files_of(newest(broken_off)), key=lambda file: file.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:10])
    run(broken_off)
    assert f"{largest} is damaged: going on from checkpoint-000000000064" in capsys.readouterr().err
    for name in ("eval.csv", "policy.safetensors"):
        assert (broken_off / name).read_bytes() == (stopped / "whole" / name).read_bytes()


def test_a_run_without_a_whole_one_is_refused_by_name_and_kept(broken_off):
    for checkpoint in broken_off.glob("checkpoints/checkpoint-*[0-9]"):
        empty(files_of(checkpoint)[0], random.Random(0))
    before = (broken_off / "eval.csv").read_bytes()
    with pytest.raises(SystemExit, match=r"No checkpoint is whole: .*resume=false") as error:
        run(broken_off)
    assert str(files_of(newest(broken_off))[0].parent) in str(error.value)
    assert (broken_off / "eval.csv").read_bytes() == before
    run(broken_off, "resume=false")


def test_files_of_another_run_are_seen(broken_off, stopped, capsys):
    store = Checkpoints(broken_off / "checkpoints", 2, identity_of(broken_off))
    name = next(
        file.relative_to(newest(broken_off)) for file in files_of(newest(broken_off)) if file.suffix == ".memmap"
    )
    shutil.copy(newest(stopped / "other") / name, newest(broken_off) / name)
    assert store.newest() != newest(broken_off)
    shutil.rmtree(broken_off / "checkpoints")
    shutil.copytree(stopped / "other/checkpoints", broken_off / "checkpoints")
    with pytest.raises(ValueError, match="is the checkpoint of another run"):
        store.newest()


def test_one_that_was_published_and_not_sealed_is_not_used(broken_off, capsys):
    checkpoint = newest(broken_off)
    checkpoint.with_name(f"{checkpoint.name}.sha256.json").unlink()
    assert Checkpoints(broken_off / "checkpoints", 2, identity_of(broken_off)).newest() != checkpoint
    assert "which is written last, is not there" in capsys.readouterr().err


def test_a_run_that_was_killed_in_its_first_checkpoint_starts_anew(broken_off, stopped, capsys):
    first, second = sorted(path for path in (broken_off / "checkpoints").iterdir() if path.is_dir())
    shutil.rmtree(second)
    for path in (first, second):
        path.with_name(f"{path.name}.sha256.json").unlink()
    run(broken_off)
    assert "starting anew" in capsys.readouterr().err
    assert (broken_off / "eval.csv").read_bytes() == (stopped / "whole/eval.csv").read_bytes()


def test_a_full_disk_is_an_error_that_keeps_the_last_checkpoint(broken_off, monkeypatch):
    usage = shutil.disk_usage(broken_off)
    before = newest(broken_off)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(SystemExit, match=r"0 MB are free on the disk.*the same command continues"):
        run(broken_off)
    assert newest(broken_off) == before
    monkeypatch.undo()
    run(broken_off)
