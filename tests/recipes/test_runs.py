from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from omegaconf import OmegaConf
from sweep_cases import alive

from recipes.common.run_folder import RunFolder, digest
from recipes.gridworld.study import open_folder

CONFIG = {"worlds": 3, "student": {"lr": 0.1, "gamma": 0.95}, "methods": ["none", "er"]}
NUMBERS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False])}


def contents(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def never() -> dict[str, np.ndarray]:
    raise AssertionError("computed again")


def test_digest_depends_on_every_value_and_not_on_the_order_of_keys():
    shuffled = {"methods": ["none", "er"], "student": {"gamma": 0.95, "lr": 0.1}, "worlds": 3}
    assert digest(shuffled) == digest(CONFIG)
    others = [{**CONFIG, "worlds": 4}, {**CONFIG, "methods": ["er", "none"]}, {**CONFIG, "student": {"lr": 0.1}}]
    assert len({digest(config) for config in [CONFIG, *others]}) == 4


def test_folder_keeps_its_configuration_for_people_and_for_itself(tmp_path):
    folder = RunFolder(tmp_path / "a" / "b", CONFIG, "worlds: 3\n")
    assert (folder.path / "config.yaml").read_text() == "worlds: 3\n"
    assert json.loads((folder.path / "config.json").read_text()) == CONFIG


def test_same_configuration_finds_its_arrays_again(tmp_path):
    RunFolder(tmp_path, CONFIG, "").arrays("blocks/0", lambda: NUMBERS)
    folder = RunFolder(tmp_path, CONFIG, "")
    assert folder.has("blocks/0")
    assert not folder.has("blocks/1")
    for again in (folder.arrays("blocks/0", never), folder.arrays("blocks/0")):
        assert again.keys() == NUMBERS.keys()
        assert all(np.array_equal(again[name], NUMBERS[name]) for name in NUMBERS)
        assert again["b"].dtype == bool


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"worlds": 4}, "worlds: 3 -> 4"),
        ({"student": {"lr": 0.2, "gamma": 0.95}}, r"student\.lr: 0\.1 -> 0\.2"),
        ({"extra": 1}, "extra: absent -> 1"),
        ({"methods": ["none"]}, "methods: .* -> "),
    ],
)
def test_another_configuration_is_refused_by_what_differs_and_changes_nothing(tmp_path, change, message):
    RunFolder(tmp_path, CONFIG, "old").arrays("blocks/0", lambda: NUMBERS)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=message) as error:
        RunFolder(tmp_path, {**CONFIG, **change}, "new")
    assert str(tmp_path) in str(error.value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.yaml", "a: 1", "config.yaml that is not of this recipe"),
        ("config.json", "[1]", r"config\.json is damaged: expected a JSON object, found list"),
        ("config.json", "x{", r"config\.json is damaged: expected a JSON object"),
        ("config.json", "\N{DEGREE SIGN}".encode("latin-1"), r"config\.json is damaged"),
    ],
)
def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path, file, content, message):
    (tmp_path / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=message):
        RunFolder(tmp_path, CONFIG, "new")
    assert contents(tmp_path) == before


def test_a_folder_whose_first_file_only_was_written_is_continued(tmp_path, monkeypatch):
    write = RunFolder.write

    def killed(self, name, content):
        write(self, name, content)
        raise KeyboardInterrupt

    monkeypatch.setattr(RunFolder, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        RunFolder(tmp_path, CONFIG, "text")
    monkeypatch.undo()
    assert (RunFolder(tmp_path, CONFIG, "text").path / "config.yaml").read_text() == "text"


HOLDER = """
import subprocess, sys, time
from pathlib import Path
from recipes.common.run_folder import RunFolder

folder = RunFolder(Path(sys.argv[1]), {"worlds": 3}, "")
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
print(child.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_folder_is_one_processs_until_it_dies_whatever_becomes_of_its_children(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        child = int(holder.stdout.readline())
        with pytest.raises(ValueError, match="another process is at work"):
            RunFolder(tmp_path, {"worlds": 3}, "")
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        assert alive(child)
        try:
            RunFolder(tmp_path, {"worlds": 3}, "")
        finally:
            os.kill(child, signal.SIGKILL)


def test_a_file_system_without_locks_is_worked_on_without(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(FileLock, "acquire", refuse)
    assert RunFolder(tmp_path, CONFIG, "").config == CONFIG


def test_file_in_the_way_is_named_and_stays(tmp_path):
    (tmp_path / "out").write_text("precious")
    for path in (tmp_path / "out", tmp_path / "out" / "below"):
        with pytest.raises(OSError, match="out="):
            RunFolder(path, CONFIG, "")
    assert (tmp_path / "out").read_text() == "precious"


def test_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path, CONFIG, "")
    folder.write("table.csv", "old")
    before = contents(tmp_path)

    def fail(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)  # by then the new one is written
    with pytest.raises(OSError, match="No space"):
        folder.write("table.csv", "new")
    assert contents(tmp_path) == before


def test_what_a_killed_process_was_writing_is_removed_when_it_is_continued(tmp_path):
    RunFolder(tmp_path, CONFIG, "").arrays("blocks/0", lambda: NUMBERS)
    before = contents(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    for name in (".eval.csv.12.partial", "blocks/.1.npz.12.partial", ".policy.safetensors.0a1b2c3d.partial"):
        (tmp_path / name).write_text("half")
    (tmp_path / "checkpoints" / ".checkpoint-000000000064.stage-0a").mkdir()
    (tmp_path / ".hidden").write_text("somebody's")
    RunFolder(tmp_path, CONFIG, "")
    assert contents(tmp_path) == before | {".hidden": b"somebody's"}
    assert not list((tmp_path / "checkpoints").iterdir())


def test_computation_that_fails_leaves_nothing_behind(tmp_path):
    folder = RunFolder(tmp_path, CONFIG, "")
    with pytest.raises(AssertionError):
        folder.arrays("blocks/0", never)
    assert not folder.has("blocks/0")


@pytest.mark.parametrize("damage", [b"", b"no archive", "half", "flipped"])
def test_damaged_arrays_are_named_and_kept(tmp_path, damage):
    folder = RunFolder(tmp_path, CONFIG, "")
    folder.arrays("blocks/0", lambda: NUMBERS)
    file = tmp_path / "blocks" / "0.npz"
    whole = file.read_bytes()
    if damage == "half":
        damage = whole[: len(whole) // 2]
    elif damage == "flipped":
        at = whole.index(NUMBERS["a"].tobytes()) + 20
        damage = whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :]
    file.write_bytes(damage)
    with pytest.raises(ValueError, match=r"0\.npz is damaged .*: delete it"):
        folder.arrays("blocks/0", never)
    assert file.read_bytes() == damage


def test_arrays_that_were_not_computed_are_missing_not_made_up(tmp_path):
    with pytest.raises((ValueError, OSError), match="blocks/7"):
        RunFolder(tmp_path, CONFIG, "").arrays("blocks/7")


def test_default_folder_differs_for_each_configuration(tmp_path):
    plain = {"name": "small", "out": None, "block_worlds": 1, "methods": ["none"], "schedule": {"methods": "annealed"}}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        paths = [
            open_folder(OmegaConf.create({**plain, "seed": seed, "workers": workers})).path
            for seed, workers in ((0, 1), (0, 2), (1, 1))
        ]
    assert paths[0] == paths[1]
    assert paths[2] != paths[0]
