"""Work on many rows block by block: what is made on the way stays in the cache, and blocks share the cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

_BLOCK_ROWS = 4096
_ROWS_WORTH_THREADS = 1 << 16


def blocks(n: int) -> Iterator[slice]:
    """Slices of at most ``_BLOCK_ROWS`` rows that cover n rows."""
    return (slice(start, min(start + _BLOCK_ROWS, n)) for start in range(0, n, _BLOCK_ROWS))


def for_blocks(n: int, work: Callable[[slice], None]) -> None:
    """Call `work` for every block; in threads where there is much to do (NumPy lets go of the interpreter's lock).

    Blocks write to disjoint rows, so the result does not depend on their order. An error of the first block that has
    one is raised.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if n < _ROWS_WORTH_THREADS or cores == 1:
        for rows in blocks(n):
            work(rows)
        return
    with ThreadPoolExecutor(cores) as pool:
        for _ in pool.map(work, blocks(n)):
            pass
