"""A progress bar that suits where it is printed: one line in a terminal, a line now and then in a file."""

from __future__ import annotations

import sys
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["progress_bar"]

#: Seconds between the lines in a file.
_SELDOM = 60
#: How tqdm goes back to the line above.
_UP = "\x1b[A"


class _Lines:
    """Standard error, with a new line where a terminal would write over the last one."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        """Write what is more than a return to the start of the line."""
        if line := text.replace(_UP, "").strip():
            self._stream.write(line + "\n")

    def flush(self) -> None:
        """Pass it on."""
        self._stream.flush()


def progress_bar(**options: Any) -> tqdm:
    """A bar of :mod:`tqdm`, with its options."""
    if not sys.stderr.isatty():
        options |= {"file": _Lines(sys.stderr), "mininterval": _SELDOM, "maxinterval": _SELDOM, "ncols": 80}
    return tqdm(**options)
