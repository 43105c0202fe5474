"""What a run's folder says of it, which may be damaged or another's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from recipes.common.run_folder import flatten

__all__ = ["read_config", "reading"]


def read_config(folder: Path) -> Any:
    """The configuration of a run as it stands: what another's has in ``${...}`` could be a secret of this machine.

    Raises:
        ValueError: it is damaged, or has such an entry, which no run writes; names the file.
    """
    file = folder / "config.yaml"
    with reading(file):
        values = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
    if not isinstance(values, dict):
        raise ValueError(f"{file} is damaged: expected keys and values, got a {type(values).__name__}.")
    for key, value in flatten({str(key): value for key, value in values.items()}).items():
        if "${" in str(value):
            raise ValueError(
                f"{file} is not as a run writes it: {key}={value!r} refers to something else. Not looked up."
            )
    return OmegaConf.create(values)


@contextmanager
def reading(source: Path) -> Iterator[None]:
    """Names what was read where that fails, in one line, whatever damage ends in.

    Raises:
        ValueError: it is damaged. What else is a ``ValueError`` or ``OSError`` says itself what it is about.
    """
    try:
        yield
    except (OSError, ImportError):
        raise
    except Exception as error:
        foreign = isinstance(error, (OmegaConfBaseException, UnicodeError)) or not isinstance(error, ValueError)
        if not foreign:
            raise
        reason = (str(error).strip().splitlines() or [""])[0]
        raise ValueError(f"{source} is damaged or of another release ({type(error).__name__}: {reason}).") from error
