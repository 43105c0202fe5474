"""What recipes check before they work: keys and their values, the file to write, a C++ compiler."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import Field, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf

__all__ = [
    "at_home",
    "at_least_0",
    "check_keys",
    "finite",
    "one_of",
    "positive",
    "require",
    "require_compiler",
    "require_file_name",
    "share",
]


def _expect(expected: str, holds: Callable[[Any], bool]) -> Any:
    return field(default=MISSING, metadata={"expected": expected, "holds": holds})


def positive(below: float = math.inf) -> Any:
    """An entry of a schema: a number above 0."""
    return _expect("a positive number" + _below(below), lambda value: 0 < value < below)


def at_least_0(below: float = math.inf) -> Any:
    """An entry of a schema: a number that is not negative."""
    return _expect("a number of at least 0" + _below(below), lambda value: 0 <= value < below)


def _below(limit: float) -> str:
    return "" if limit == math.inf else f", below 2**{math.log2(limit):g}"


def finite() -> Any:
    """An entry of a schema: a number that is finite."""
    return _expect("a finite number", math.isfinite)


def share() -> Any:
    """An entry of a schema: a number from 0 to 1."""
    return _expect("a number in [0, 1]", lambda value: 0 <= value <= 1)


def one_of(*choices: str) -> Any:
    """An entry of a schema: one of some words (or null, where its type allows that)."""
    return _expect(f"one of {', '.join(choices)}", lambda value: value in choices)


def require(holds: bool, key: str, value: Any, expected: str) -> None:
    """Refuse the value of a key.

    Raises:
        ValueError: it does not hold; names the key, its value and what was expected.
    """
    if not holds:
        raise ValueError(f"{key}={value}: expected {expected}.")


def check_keys(cfg: Any) -> None:
    """Hold a configuration against its schema.

    Refuses keys that ``+key=value`` appended, which Hydra takes and nothing would read; keys without a value; and
    values that are not what :func:`positive` and the like ask for.

    Raises:
        ValueError: names the keys.
    """
    if not OmegaConf.is_config(cfg):
        return
    if unknown := [key for key, entry in _entries(cfg, "") if entry is None]:
        raise ValueError(f"{', '.join(unknown)}: there is no such key.")
    if missing := sorted(OmegaConf.missing_keys(cfg)):
        raise ValueError(f"{', '.join(f'{key}=' for key in missing)}: expected a value (see --help), none was given.")
    for key, entry in _entries(cfg, ""):
        value = OmegaConf.select(cfg, key)
        if entry is not None and "holds" in entry.metadata and value is not None:
            require(entry.metadata["holds"](value), key, value, entry.metadata["expected"])


def _entries(cfg: Any, prefix: str) -> Iterator[tuple[str, Field | None]]:
    """The keys of a configuration and those below them, each with its entry in the schema if there is one."""
    schema = OmegaConf.get_type(cfg)
    if not is_dataclass(schema):  # in a mapping any key may be
        return
    known = {entry.name: entry for entry in fields(schema)}
    for key in cfg:
        yield f"{prefix}{key}", known.get(key)
        if key in known and not OmegaConf.is_missing(cfg, key) and OmegaConf.is_config(cfg[key]):
            yield from _entries(cfg[key], f"{prefix}{key}.")


def at_home(key: str, path: str) -> Path:
    """A path whose ``~`` is one's home directory.

    Raises:
        ValueError: ``~name`` is nobody's.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise ValueError(f"{key}={path}: {error}") from None


def require_file_name(out: str) -> None:
    """Refuse a folder where the name of a file is expected.

    Raises:
        ValueError: says so.
    """
    if Path(out).is_dir():
        raise ValueError(f"out={out}: this is a folder, expected the name of the file to write.")


def require_compiler(compiled: bool, device: str = "cpu") -> None:
    """Refuse ``compile=true`` where PyTorch finds no C++ compiler.

    Raises:
        ValueError: says so, and what to do instead.
    """
    if not compiled or device != "cpu":
        return
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        get_cpp_compiler()
    except RuntimeError as error:
        raise ValueError(
            f"compile=true: no C++ compiler is there ({error}). Install one, such as g++, or use compile=false, "
            "which is slower."
        ) from None
