"""Work in threads: matching, linear algebra and PnP release Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Event, current_thread, main_thread
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from conformodal.core.process import thread_limit
from conformodal.core.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

_interrupted = Event()


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None) -> list[Result]:
    """Results of `work` in the order of the items, which do not depend on the number of threads.

    Matrix products take one thread each: idle BLAS threads spin, which slows whatever runs at the same time. An
    interrupt of the main thread ends the others at their next item.
    """

    def checked(item: Item) -> Result:
        go_on()
        return work(item)

    found = []
    if current_thread() is main_thread():
        _interrupted.clear()
    with _threads().limit(limits=1, user_api="blas"), ThreadPoolExecutor(thread_limit()) as pool:
        try:
            for result in (pool.map if min(len(items), thread_limit()) > 1 else map)(checked, items):
                found.append(result)
                if progress is not None:
                    progress(len(found), len(items))
        except KeyboardInterrupt:
            _interrupted.set()
            raise
    return found


def side_by_side(one: Callable[[], Item], other: Callable[[], Result]) -> tuple[Item, Result]:
    """Results of two pieces of work that run at the same time, see :func:`in_threads`."""
    jobs: list[Callable[[], Any]] = [one, other]
    first, second = in_threads(lambda job: job(), jobs)
    return first, second


def go_on() -> None:
    """Raise KeyboardInterrupt in other threads if the main thread was interrupted."""
    if _interrupted.is_set() and current_thread() is not main_thread():
        raise KeyboardInterrupt


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()
