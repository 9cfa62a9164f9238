"""Threads and memory of this process."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

_limit: int | None = None


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
