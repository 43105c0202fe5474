"""Signals to a run: a cluster takes the machine away, and may queue the run again; what started it has ended."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NoReturn

__all__ = ["Notice", "end_with_parent"]

_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Have Linux send SIGTERM to this process when the one that started it ends, even by force."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Notice:
    """Calls ``stop`` at SIGTERM, and at the signal by which submitit queues its job again, until it is released.

    Slurm sends SIGTERM first, which submitit lets pass, and then the other. submitit's handler of it ends the process
    in the middle of whatever it does; here the job saves itself first, and then calls that handler by :meth:`leave`.

    Args:
        stop (Callable): a handler of signals.
    """

    def __init__(self, stop: Callable[..., None]) -> None:
        self._before: dict[int, Any] = {}
        self._queues = getattr(signal, f"SIG{os.environ.get('SUBMITIT_PREEMPT_SIGNAL', 'USR2')}")
        with suppress(ValueError):  # not the main thread
            if callable(signal.getsignal(self._queues)):
                self._before[self._queues] = signal.signal(self._queues, stop)
            self._before.setdefault(signal.SIGTERM, signal.signal(signal.SIGTERM, stop))

    def release(self) -> None:
        """Give the signals back to who handled them."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def leave(self, code: int) -> NoReturn:
        """End the process: back into the queue where submitit started it, else with an exit status."""
        self.release()
        if callable(again := self._before.get(self._queues)):
            again(self._queues, None)
        sys.exit(code)
