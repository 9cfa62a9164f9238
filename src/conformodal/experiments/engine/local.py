"""Tasks on this machine: here, one after the other, or in processes of their own."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context

import torch

from ..errors import ExperimentError
from .engines import Result, Task, Work


@dataclass(frozen=True)
class LocalEngine:
    """One machine: the one that this runs on.

    Attributes
    ----------
    workers
        Tasks at a time. One works in this process, with all cores; more share the cores evenly, in processes that
        start anew. Small networks use one core each far better than all cores together.

    Raises
    ------
    ExperimentError
        If there are fewer workers than one.
    """

    workers: int = 1

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ExperimentError(f"workers must be at least 1, got {self.workers}")

    def results(self, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """See :class:`~conformodal.experiments.engine.Engine`."""
        if self.workers == 1 or len(tasks) < 2:
            for i, task in enumerate(tasks):
                yield i, work(task)
            return
        threads = max(1, (os.cpu_count() or 1) // self.workers)
        pool = ProcessPoolExecutor(
            self.workers, mp_context=get_context("spawn"), initializer=_start, initargs=(threads, work)
        )
        try:
            waiting = {pool.submit(_work, task): i for i, task in enumerate(tasks)}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


_working: list[Work] = []  # of a worker process: sent once, so that what it remembers serves the next task


def _start(threads: int, work: Work) -> None:
    torch.set_num_threads(threads)
    _working[:] = [work]


def _work(task: Task) -> Result:
    return _working[0](task)
