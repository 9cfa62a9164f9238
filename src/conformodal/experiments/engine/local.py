"""Tasks on this machine: here, one after the other, or in processes of their own."""

from __future__ import annotations

import os
import threading
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process

from ..errors import ExperimentError
from .engines import Result, Task, Work
from .threads import limit_threads


@dataclass(frozen=True)
class LocalEngine:
    """One machine: the one that this runs on.

    Attributes
    ----------
    workers
        Tasks at a time. One works in this process, with all cores; more share the cores evenly, in processes that
        start anew. Small networks use one core each far better than all cores together. A worker goes on with tasks of
        the group that it has begun, and helps others when no group is left.

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
        """See :class:`~conformodal.experiments.engine.Engine`.

        Raises
        ------
        ExperimentError
            If a worker process dies, as where memory runs out.
        """
        if self.workers == 1 or len(tasks) < 2:
            for i, task in enumerate(tasks):
                yield i, work(task)
            return
        threads = max(1, (os.cpu_count() or 1) // self.workers)
        # a pool each: only so is it known which process gets a task
        pools = [
            ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_start, initargs=(threads, work))
            for _ in range(min(self.workers, len(tasks)))
        ]
        left = dict(enumerate(task.group for task in tasks))
        begun: dict[int, str] = {}  # by worker
        running: dict[Future[Result], tuple[int, int]] = {}

        def go_on(worker: int) -> None:
            i = _next(left, begun.get(worker), begun.values())
            if i is not None:
                begun[worker] = left.pop(i)
                running[pools[worker].submit(_work, tasks[i])] = (worker, i)

        try:
            for worker in range(len(pools)):
                go_on(worker)
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, i = running.pop(future)
                    result = future.result()
                    go_on(worker)
                    yield i, result
        except BrokenProcessPool as exc:
            raise ExperimentError(
                "a worker process was killed, perhaps for want of memory; results that came before are kept, and the "
                "same command goes on, best with fewer workers"
            ) from exc
        finally:
            for pool in pools:
                pool.shutdown(wait=True, cancel_futures=True)


def _next(left: dict[int, str], mine: str | None, begun: Collection[str]) -> int | None:
    """The first task of my group, else of one that nobody has begun, else the first of all; None if none is left."""
    choices = (lambda group: group == mine, lambda group: group not in begun, lambda _: True)
    return next((i for fits in choices for i, group in left.items() if fits(group)), None)


_working: list[Work] = []  # of a worker process: sent once, so that what it remembers serves the next task


def _start(threads: int, work: Work) -> None:
    watch_parent()
    limit_threads(threads)
    _working[:] = [work]


def watch_parent() -> None:
    """End this worker when the process that started it is gone: a killed one cannot stop its workers itself."""
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _work(task: Task) -> Result:
    return _working[0](task)
