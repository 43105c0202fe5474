"""A run's folder: its resolved configuration, files that are either whole or not there, one process at a time."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from recipes.common.checks import at_home
from torchrl_priors.atomic import write_atomically

__all__ = ["RunFolder", "digest", "flatten", "keep_others_out", "read_json", "refuse_foreign", "sha256", "write_file"]

#: Temporary names: of the atomic writer, and of TorchRL's checkpoints (being written or removed).
_LEFTOVERS = (".*.partial", "*/.*.partial", "checkpoints/.checkpoint-*")


def digest(config: dict[str, Any]) -> str:
    """Eight characters that tell two configurations apart."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:8]


def sha256(file: Path) -> str:
    """The digest of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


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


def flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A configuration as ``{"a.b": value}``."""
    flat: dict[str, Any] = {}
    for name, value in config.items():
        flat.update(flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return flat


def write_file(file: Path, content: str | bytes) -> Path:
    """Write a file, in folders that are made if needed, that is either whole or as it was before."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, content.encode() if isinstance(content, str) else content)
    return file


def keep_others_out(file: Path, refusal: str) -> FileLock:
    """A lock that is held until it is released or its process ends; on a file system without locks, for nothing.

    Raises:
        ValueError: another process holds it; the message begins with ``refusal``.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(file)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise ValueError(f"{refusal}. Wait for it, end it, or choose another.") from None
    except (NotImplementedError, OSError):
        pass
    return lock


class RunFolder:
    """A folder for the results of one configuration, to be continued by the same configuration only.

    While the object lives, other processes are kept out of the folder. The lock ends with the process, however that
    does.

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
        path = at_home("out", str(path))
        self.path, self.config = path, config
        stamp = path / "config.json"
        try:
            path.mkdir(parents=True, exist_ok=True)
            known = stamp.exists()
            if known:
                self._check_same(read_json(stamp), config, may_grow)
            elif (path / "config.yaml").exists():
                raise ValueError(f"out={path} holds a config.yaml that is not of this recipe: choose another folder.")
            self._lock = keep_others_out(path / ".lock", f"out={path}: another process is at work in this folder")
            if known:
                self._remove_leftovers()
            # first what makes the folder this recipe's: it may be killed in between
            self.write("config.json", json.dumps(config, indent=1, sort_keys=True))
            self.write("config.yaml", text)
        except OSError as error:
            raise OSError(f"Cannot write the results to out={path}: {error}") from error

    def _check_same(self, theirs: dict[str, Any], ours: dict[str, Any], may_grow: Sequence[str]) -> None:
        before, now = flatten(theirs), flatten(ours)
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

    def release(self) -> None:
        """Let others work in the folder."""
        self._lock.release()

    @staticmethod
    def is_at_work(path: Path) -> bool:
        """Whether a process is at work in a folder; False where that can't be told."""
        if not (path / ".lock").exists():
            return False
        try:
            with FileLock(path / ".lock", blocking=False):
                return False
        except Timeout:
            return True
        except (NotImplementedError, OSError):
            return False

    def _remove_leftovers(self) -> None:
        """Remove what was being written when the process was killed."""
        for pattern in _LEFTOVERS:
            for path in self.path.glob(pattern):
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file that is either whole or as it was before."""
        return write_file(self.path / name, content)

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
        arrays, stream = compute(), io.BytesIO()
        np.savez(stream, **arrays)  # type: ignore[arg-type]
        self.write(f"{name}.npz", stream.getvalue())
        return arrays
