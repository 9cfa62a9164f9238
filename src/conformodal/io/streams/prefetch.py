"""Decoding ahead in a thread, so that nobody waits for the disk."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import suppress
from enum import StrEnum
from queue import Empty, Full, Queue
from threading import Event, Thread

from conformodal.core.ranges import as_member

from .frames import Frame, FrameStream, SourceError

DEPTH = 4
_WAIT_S = 0.1  # after which the thread looks whether its taker has gone


class Pace(StrEnum):
    """How fast a stored source is played."""

    FAST = "fast"
    CAMERA = "camera"


def prefetch(stream: FrameStream, depth: int = DEPTH, pace: Pace | str = Pace.FAST) -> Generator[Frame]:
    """Frames of a stream, decoded ahead; its :class:`SourceError` comes after all frames before it.

    Stored sources wait when `depth` frames are ready; the pace ``camera`` plays them by their timestamps. Then, and
    where the source is live, nothing waits: the oldest frame that was not taken yet is lost, as it would be to a robot.
    """
    pace = as_member(pace, Pace, "pace", SourceError)
    by_time, lossy = pace is Pace.CAMERA and not stream.live, stream.live or pace is Pace.CAMERA
    ready: Queue[Frame | BaseException | None] = Queue(depth)  # None ends it
    stopped = Event()

    def offer(item: Frame | BaseException | None) -> None:
        while not stopped.is_set():
            if lossy and ready.full():
                with suppress(Empty):
                    ready.get_nowait()
            with suppress(Full):
                return ready.put(item, timeout=_WAIT_S)

    def decode() -> None:
        start_s: float | None = None
        try:
            for frame in stream:
                if by_time:
                    start_s = time.monotonic() - frame.timestamp_s if start_s is None else start_s
                    time.sleep(max(0.0, start_s + frame.timestamp_s - time.monotonic()))
                offer(frame)
                if stopped.is_set():
                    return
            offer(None)
        except BaseException as exc:
            offer(exc)

    thread = Thread(target=decode, name="decoder", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stopped.set()
        thread.join(timeout=5)
