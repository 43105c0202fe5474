"""Independent pieces of work on several processes, which end together with the process that started them."""

from __future__ import annotations

import multiprocessing as mp
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import suppress
from queue import Empty
from typing import Any

import torch

__all__ = ["run_all"]

_queue: Any = None


def _start_worker(queue: Any) -> None:
    global _queue
    _queue = queue
    torch.set_num_threads(1)
    parent = mp.parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)  # an orphan would wait for work for ever

    threading.Thread(target=follow, daemon=True).start()


def _report(amount: int) -> None:
    _queue.put(amount)


def _work(function: Callable, job: Any) -> None:
    function(job, _report)


def run_all(
    function: Callable[[Any, Callable[[int], Any]], None],
    jobs: Iterable[Any],
    workers: int,
    progress: Callable[[int], Any],
) -> None:
    """Call ``function(job, report)`` for every job.

    Args:
        function (callable): picklable; calls ``report(amount)`` as it gets on, and keeps its results itself.
        jobs (iterable): picklable.
        workers (int): processes, of one thread each; 1 stays in this process.
        progress (callable): called here with every amount reported.
    """
    jobs = list(jobs)
    if workers == 1 or len(jobs) <= 1:
        for job in jobs:
            function(job, progress)
        return
    context = mp.get_context("spawn")
    queue = context.Queue()
    with ProcessPoolExecutor(min(workers, len(jobs)), context, _start_worker, (queue,)) as pool:
        pending = {pool.submit(_work, function, job) for job in jobs}
        try:
            while pending:
                finished, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
                with suppress(Empty):
                    while True:
                        progress(queue.get_nowait())
                for future in finished:
                    future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
