"""Work in threads: matching, linear algebra and PnP release Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

from conformodal.core.process import thread_limit
from conformodal.core.progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None) -> list[Result]:
    """Results of `work` in the order of the items, which do not depend on the number of threads.

    Matrix products take one thread each: idle BLAS threads spin, which slows whatever runs at the same time.
    """
    found = []
    with _threads().limit(limits=1, user_api="blas"), ThreadPoolExecutor(thread_limit()) as pool:
        for result in (pool.map if min(len(items), thread_limit()) > 1 else map)(work, items):
            found.append(result)
            if progress is not None:
                progress(len(found), len(items))
    return found


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()
