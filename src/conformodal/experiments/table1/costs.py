"""What a method costs: trained numbers, and time an answer."""

from __future__ import annotations

import time
from collections.abc import Callable

from conformodal.vision import Head


def n_numbers(head: Head) -> int:
    """Trained numbers of a head."""
    return sum(p.numel() for p in head.parameters())


def ms_a_frame(answer: Callable[[], object], n_frames: int) -> float:
    """Wall time of the second of two calls, in milliseconds a frame."""
    answer()
    started = time.perf_counter()
    answer()
    return 1e3 * (time.perf_counter() - started) / n_frames
