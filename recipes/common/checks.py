"""What recipes check before they work: their keys, the file to write, and a C++ compiler where one is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

__all__ = ["check_keys", "require_compiler", "require_file_name"]


def check_keys(cfg: Any) -> None:
    """Refuse keys that ``+key=value`` appended, which Hydra takes and nothing would read, and keys without a value.

    Raises:
        ValueError: names the keys.
    """
    if unknown := list(_unknown(cfg, "")):
        raise ValueError(f"{', '.join(unknown)}: there is no such key.")
    if missing := sorted(OmegaConf.missing_keys(cfg)) if OmegaConf.is_config(cfg) else ():
        raise ValueError(f"{', '.join(f'{key}=' for key in missing)}: expected a value (see --help), none was given.")


def _unknown(cfg: Any, prefix: str) -> Iterator[str]:
    schema = OmegaConf.get_type(cfg)
    if is_dataclass(schema):  # in a mapping any key may be
        known = {field.name for field in fields(schema)}
        for key in cfg if OmegaConf.is_config(cfg) else ():
            if key not in known:
                yield f"{prefix}{key}"
            elif not OmegaConf.is_missing(cfg, key) and OmegaConf.is_config(cfg[key]):
                yield from _unknown(cfg[key], f"{prefix}{key}.")


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
