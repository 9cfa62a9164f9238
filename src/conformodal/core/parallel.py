"""Work in threads (matching, linear algebra and PnP release Python's lock) and processes, and memory of this one."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, suppress
from contextvars import ContextVar, copy_context
from functools import cache
from typing import TypeVar

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky.process_executor import BrokenProcessPool
from threadpoolctl import ThreadpoolController

from .errors import ConformodalError
from .progress import Progress

Item = TypeVar("Item")
Result = TypeVar("Result")

# set when a call of in_threads that the thread works for has failed, for those around the innermost one too
_failed: ContextVar[tuple[threading.Event, ...]] = ContextVar("failed", default=())


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None) -> list[Result]:
    """Results of `work` in the order of the items, which do not depend on the number of threads.

    Matrix products take one thread each, see :func:`one_blas_thread`. The first error, or an interrupt of the main
    thread, ends what the other threads do, see :func:`raise_if_cancelled`.
    """
    failed, context = threading.Event(), copy_context()
    context.run(_failed.set, (*_failed.get(), failed))

    def checked(item: Item) -> Result:
        raise_if_cancelled()
        return work(item)

    if len(items) == 1 and progress is None:  # as for each frame of a stream
        with one_blas_thread():
            return [context.run(checked, items[0])]
    with one_blas_thread(), ThreadPoolExecutor(thread_limit()) as pool:
        futures = [pool.submit(context.copy().run, checked, item) for item in items]
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                future.result()
                if progress is not None:
                    progress(done, len(items))
        except BaseException:
            failed.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


def in_workers(work: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None = None) -> list[Result]:
    """As :func:`in_threads`, by the workers of :func:`joblib.parallel_config` if there are any and several items."""
    try:
        workers, results = Parallel(return_as="generator", batch_size=1), list[Result]()
    except ValueError:  # the backend, as Ray's, has no generator: progress comes at the end
        workers, results = Parallel(batch_size=1), []
    if workers.n_jobs == 1 or len(items) < 2:
        return in_threads(work, items, progress)
    try:
        for result in workers(delayed(_alone)(work, item) for item in items):
            results.append(result)
            if progress is not None:
                progress(len(results), len(items))
    except BrokenProcessPool:
        raise ConformodalError("a worker process was killed, perhaps for its memory: take fewer workers") from None
    return results


def _alone(work: Callable[[Item], Result], item: Item) -> Result:
    with one_blas_thread():
        return work(item)


def raise_if_cancelled() -> None:
    """Raise KeyboardInterrupt if other work of a call of :func:`in_threads` around this one has failed."""
    if any(event.is_set() for event in _failed.get()):
        raise KeyboardInterrupt


def one_blas_thread() -> AbstractContextManager[object]:
    """Matrix products take one thread: idle BLAS threads spin, which costs a core and slows whatever else runs."""
    limited: AbstractContextManager[object] = _threads().limit(limits=1, user_api="blas")
    return limited


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def thread_limit() -> int:
    """``$OMP_NUM_THREADS``, or the cores that this process may use."""
    stated = os.environ.get("OMP_NUM_THREADS", "")
    return (int(stated) if stated.isdigit() else 0) or cpu_count()


def release_freed_memory() -> None:
    """Return freed memory to the system if the C library is glibc, which keeps what lies between blocks in use.

    Without it, a stream that frees arrays of many sizes for hours seems to leak.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def peak_memory_bytes() -> int:
    """Most memory that this process had until now; 0 where the system does not tell."""
    try:
        import resource  # noqa: PLC0415 - not everywhere
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
