"""Checkpoints that are either whole or not used: a digest of every file stands beside each."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointRotation

from recipes.common.run_folder import refuse_foreign, sha256, write_file

__all__ = ["Checkpoints"]

#: Bytes that a first checkpoint is taken to need; afterwards it is known.
_FIRST = 16 * 2**20


class Checkpoints:
    """The last checkpoints of a run, in one folder.

    Args:
        folder (Path): of the checkpoints.
        keep (int): how many of them.
        identity (str): what tells the run's configuration from others. A checkpoint of another run is not used.
    """

    def __init__(self, folder: Path, keep: int, identity: str) -> None:
        self.folder, self.identity = folder, identity
        # one more until the new one is sealed, so that a kill between the two leaves one that is whole
        self._rotation, self._pruned = (CheckpointRotation(folder, keep_last=number) for number in (keep + 1, keep))

    def save(self, parts: Mapping[str, Any], frames: int) -> None:
        """Save one, and what tells whether it is whole.

        Raises:
            OSError: there is no room for it on the disk. The checkpoints that are there stay.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        needed = max([_size(path) for path in self._all()], default=_FIRST)
        free = shutil.disk_usage(self.folder).free
        if free < 2 * needed:  # the arrays are memory maps: a disk that is full would end the process by a signal
            raise OSError(
                f"{self.folder}: {free // 2**20} MB are free on the disk, and a checkpoint needs"
                f" {max(1, needed // 2**20)} MB for a moment twice. Make room: the same command continues."
            )
        path = self._rotation.save(Checkpoint(**parts), step=frames)
        seal = {"run": self.identity, "files": {name: sha256(path / name) for name in _files(path)}}
        write_file(_seal(path), json.dumps(seal))
        self._pruned.prune()
        for old in self.folder.glob("*.sha256.json"):
            if not old.with_name(old.name.removesuffix(".sha256.json")).exists():
                old.unlink()

    def load(self, stage: Mapping[str, Any], parts: Callable[[], Mapping[str, Any]]) -> bool:
        """Load the newest one that is whole: first ``stage``, then what the parts are after that. Whether there is one.

        Raises:
            ValueError: there are checkpoints, and none is whole, or it could run code; the message names the file.
        """
        if (path := self.newest()) is None:
            self.clear()  # of one that was broken off
            return False
        Checkpoint(**stage).load(path, components=list(stage))
        if rest := parts():
            Checkpoint(**rest).load(path)
        return True

    def newest(self) -> Path | None:
        """The newest one that is whole, None where none was ever whole; damaged ones are named.

        Raises:
            ValueError: there are some, and none is whole, or one could run code.
        """
        damaged: list[str] = []
        for path in self._all():
            refuse_foreign(path)
            if (damage := self._damage(path)) is None:
                for line in damaged:
                    print(f"{line}: going on from {path.name}.", file=sys.stderr, flush=True)
                return path
            damaged.append(damage)
        if len(damaged) == 1 and not _seal(self._all()[0]).exists():  # the process was killed in its first checkpoint
            print(f"{damaged[0]}: starting anew.", file=sys.stderr, flush=True)
        elif damaged:
            raise ValueError(
                f"{'; '.join(damaged)}. No checkpoint is whole: put back what was damaged, or start anew with"
                " resume=false."
            )
        return None

    def clear(self) -> None:
        """Remove them all."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _all(self) -> list[Path]:
        """Newest first."""
        if not self.folder.is_dir():
            return []
        found = [path for path in self.folder.iterdir() if re.fullmatch(r"checkpoint-\d+(\.torchrl)?", path.name)]
        return sorted(found, key=lambda path: path.name, reverse=True)

    def _damage(self, path: Path) -> str | None:
        try:
            seal = json.loads(_seal(path).read_bytes())
            run, files = seal["run"], dict(seal["files"])
        except FileNotFoundError:
            return f"{path} is not used: {_seal(path).name}, which is written last, is not there"
        except (ValueError, KeyError, TypeError, OSError) as error:
            return f"{_seal(path)} is damaged ({error})"
        if run != self.identity:
            return f"{path} is the checkpoint of another run"
        there = _files(path)
        if different := sorted(set(there) ^ set(files)):
            return f"{path / different[0]} is {'missing' if different[0] in files else 'not of this checkpoint'}"
        for name in there:
            if sha256(path / name) != files[name]:
                return f"{path / name} is damaged"
        return None


def _seal(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256.json")


def _files(path: Path) -> list[str]:
    return sorted(
        file.relative_to(path).as_posix() for file in path.rglob("*") if not file.is_dir() or file.is_symlink()
    )


def _size(path: Path) -> int:
    return sum(file.lstat().st_size for file in path.rglob("*") if not file.is_dir()) if path.is_dir() else 0
