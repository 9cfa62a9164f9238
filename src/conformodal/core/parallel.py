"""Work in threads (matching, linear algebra and PnP release Python's lock), and memory of this process."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from contextvars import ContextVar
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from .progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

_limit: int | None = None
# the errors of each call of in_threads that the thread works for, of those around the innermost one too
_errors: ContextVar[tuple[list[BaseException], ...]] = ContextVar("errors", default=())


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None) -> list[Result]:
    """Results of `work` in the order of the items, which do not depend on the number of threads.

    Matrix products take one thread each, see :func:`one_blas_thread`. The first error, or an interrupt of the main
    thread, ends what the other threads do, see :func:`go_on`.
    """
    errors: list[BaseException] = []
    around = (*_errors.get(), errors)

    def checked(item: Item) -> Result:
        before = _errors.set(around)
        try:
            go_on()
            return work(item)
        except BaseException as exc:
            errors.append(exc)
            raise
        finally:
            _errors.reset(before)

    found = []
    with one_blas_thread(), ThreadPoolExecutor(thread_limit()) as pool:
        try:
            for result in (pool.map if min(len(items), thread_limit()) > 1 else map)(checked, items):
                found.append(result)
                if progress is not None:
                    progress(len(found), len(items))
        except BaseException as exc:
            errors.append(exc)
    if errors:
        raise errors[0]  # the others ended because of it
    return found


def side_by_side(one: Callable[[], Item], other: Callable[[], Result]) -> tuple[Item, Result]:
    """Results of two pieces of work that run at the same time, see :func:`in_threads`."""
    jobs: list[Callable[[], Any]] = [one, other]
    first, second = in_threads(lambda job: job(), jobs)
    return first, second


def go_on() -> None:
    """Raise KeyboardInterrupt if other work of a call of :func:`in_threads` around this one has failed."""
    if any(_errors.get()):
        raise KeyboardInterrupt


def one_blas_thread() -> AbstractContextManager[object]:
    """Matrix products take one thread: idle BLAS threads spin, which costs a core and slows whatever else runs."""
    limited: AbstractContextManager[object] = _threads().limit(limits=1, user_api="blas")
    return limited


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def set_thread_limit(threads: int) -> None:
    """Pools made from now on in this process have at most so many threads."""
    global _limit  # noqa: PLW0603 - a property of the process
    _limit = threads


def thread_limit() -> int:
    """The limit that was set, or ``$OMP_NUM_THREADS``, or the cores that this process may use."""
    if _limit is not None:
        return _limit
    stated = os.environ.get("OMP_NUM_THREADS", "")
    if stated.isdigit() and int(stated) > 0:
        return int(stated)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return cores or 1


def release_freed_memory() -> None:
    """Return freed memory to the system if the C library is glibc, which keeps what lies between blocks in use.

    Without it, a stream that frees arrays of many sizes for hours seems to leak.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
