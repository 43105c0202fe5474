"""What a reader says of a file that it refuses."""

from __future__ import annotations

import itertools
import os
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

_MAX_MESSAGE = 1500  # characters


class ArtifactError(ValueError):
    """A file is not the policy that was asked for: damaged, foreign, too new, or for another environment.

    What a message shows may be from the file: letters that a terminal would obey are escaped, and the middle of a long
    one is left out.
    """

    def __init__(self, message: str) -> None:
        half = _MAX_MESSAGE // 2
        if len(message) > _MAX_MESSAGE:
            message = f"{message[:half]} ... {message[-half:]}"
        super().__init__("".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in message))


class InertPickleError(ArtifactError):
    """A pickle is damaged, or names something else than the numbers, spaces and statistics that are expected."""


@contextmanager
def refusing(path: str | os.PathLike[str], purpose: str) -> Iterator[None]:
    """Names the file in what is said against it, and what it was to be used as."""
    try:
        yield
    except ArtifactError as error:
        raise ArtifactError(f"{path} can't be used as {purpose}: {error}.") from error


def short(value: Any) -> str:
    """A value as a message can show it, however large it would be when written out."""
    try:
        return reprlib.repr(value)
    except ValueError:  # a number of more digits than Python writes
        return f"a large {type(value).__name__}"


def differing(names: Iterable[str]) -> str:
    """The first of some names of tensors, and how many more there are."""
    names = sorted(names)
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(name[:100] for name in itertools.islice(names, 5)) + more
