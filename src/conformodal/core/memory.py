"""Memory that a program has freed, given back to the system."""

from __future__ import annotations

import ctypes
from contextlib import suppress


def release_freed_memory() -> None:
    """Give freed memory back to the system, where the C library is glibc; elsewhere nothing is done.

    glibc keeps what was freed between blocks in use. A stream that frees arrays of many sizes for hours looks as if it
    leaked then.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
