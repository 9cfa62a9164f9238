"""Work in threads: matching, linear algebra and PnP release Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import ContextVar
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

from conformodal.core.process import thread_limit
from conformodal.core.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

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
