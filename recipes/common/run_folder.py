"""A run's folder: its resolved configuration, files that are either whole or not there, one process at a time."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import weakref
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

if sys.platform != "win32":
    import fcntl

__all__ = ["RunFolder", "digest", "read_json", "refuse_foreign"]

#: Temporary names: of :meth:`RunFolder.write`, of policies, and of TorchRL's checkpoints (being written or removed).
_LEFTOVERS = (".[0-9]*.*", "*/.[0-9]*.*", ".*.partial", "checkpoints/.checkpoint-*")


def digest(config: dict[str, Any]) -> str:
    """Eight characters that tell two configurations apart."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:8]


def refuse_foreign(checkpoint: Path) -> None:
    """Refuse a checkpoint that is more than folders of JSON and arrays: of other files, tensordict would run a pickle.

    Raises:
        ValueError: names the file.
    """
    for path in (checkpoint, *sorted(checkpoint.rglob("*"))):
        plain = path.is_dir() or (path != checkpoint and path.is_file() and path.suffix in (".json", ".memmap"))
        if path.is_symlink() or not plain:
            raise ValueError(
                f"{path} is not loaded: a checkpoint is a folder, of folders and files .json and .memmap only. Delete"
                " it, if it is not yours."
            )


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        ValueError: there is something else in it; the message names the file.
    """
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path} is damaged: expected a JSON object ({error}).") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} is damaged: expected a JSON object, found {type(content).__name__}.")
    return content


def _flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat.update(_flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return flat


class RunFolder:
    """A folder for the results of one configuration, to be continued by the same configuration only.

    While the object lives, other processes are kept out of the folder. Neither a child process nor a copy sent to one
    holds the lock, and it ends with the process, however that does.

    Args:
        path (Path): created if needed.
        config (dict): everything that the results depend on, as plain values.
        text (str): the resolved configuration as the user may read it, kept as ``config.yaml``.
        may_grow (sequence of str): keys whose number may be larger than it was.

    Raises:
        OSError: the folder cannot be written.
        ValueError: it holds results of another configuration, and the message names what differs; or of something
            else; or another process is at work in it.
    """

    def __init__(self, path: Path, config: dict[str, Any], text: str, may_grow: Sequence[str] = ()) -> None:
        path = path.expanduser()
        self.path, self.config = path, config
        stamp = path / "config.json"
        try:
            path.mkdir(parents=True, exist_ok=True)
            known = stamp.exists()
            if known:
                self._check_same(read_json(stamp), config, may_grow)
            elif (path / "config.yaml").exists():
                raise ValueError(f"out={path} holds a config.yaml that is not of this recipe: choose another folder.")
            self._lock()
            if known:
                self._remove_leftovers()
            # first what makes the folder this recipe's: it may be killed in between
            self.write(
                "config.json", lambda temporary: temporary.write_text(json.dumps(config, indent=1, sort_keys=True))
            )
            self.write("config.yaml", lambda temporary: temporary.write_text(text))
        except OSError as error:
            raise OSError(f"Cannot write the results to out={path}: {error}") from error

    def _check_same(self, theirs: dict[str, Any], ours: dict[str, Any], may_grow: Sequence[str]) -> None:
        before, now = _flatten(theirs), _flatten(ours)
        changed = [
            f"{name}: {before.get(name, 'absent')} -> {now.get(name, 'absent')}"
            for name in sorted(before.keys() | now.keys())
            if before.get(name, "absent") != now.get(name, "absent")
            and not (name in may_grow and name in before and now[name] >= before[name])
        ]
        if changed:
            raise ValueError(
                f"out={self.path} holds results of another configuration ({'; '.join(changed)}): choose another "
                "folder, or leave `out` to its default, which differs for each configuration."
            )

    def _lock(self) -> None:
        if sys.platform == "win32":
            return
        descriptor = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT, 0o666)  # never deleted: one file for all
        weakref.finalize(self, os.close, descriptor)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # unlike flock's, not inherited by children
        except (BlockingIOError, PermissionError):
            raise ValueError(
                f"out={self.path}: another process is at work in this folder. Wait for it, end it, or choose another."
            ) from None
        except OSError:
            pass  # a file system without locks

    @staticmethod
    def is_at_work(path: Path) -> bool:
        """Whether a process other than this one is at work in a folder; where that can't be told, True."""
        try:
            descriptor = os.open(path / ".lock", os.O_RDWR)
        except OSError:
            return sys.platform == "win32"
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return True
        finally:
            os.close(descriptor)
        return False

    def _remove_leftovers(self) -> None:
        """Remove what was being written when the process was killed."""
        for pattern in _LEFTOVERS:
            for path in self.path.glob(pattern):
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)

    def write(self, name: str, writer: Callable[[Path], Any]) -> Path:
        """Have ``writer`` fill a temporary file, then put it in place in one step."""
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(f".{os.getpid()}.{target.name}")
        try:
            writer(temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
        return target

    def has(self, name: str) -> bool:
        """Whether the arrays ``<name>.npz`` are there."""
        return (self.path / f"{name}.npz").exists()

    def arrays(self, name: str, compute: Callable[[], dict[str, np.ndarray]] | None = None) -> dict[str, np.ndarray]:
        """The arrays of ``<name>.npz``, computed and kept if they are not there yet."""
        path = self.path / f"{name}.npz"
        if compute is None or path.exists():
            try:
                with np.load(path, allow_pickle=False) as stored:
                    return dict(stored)
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
                raise ValueError(f"{path} is damaged ({error}): delete it to have it computed again.") from error
        arrays = compute()

        def save(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]

        self.write(f"{name}.npz", save)
        return arrays
