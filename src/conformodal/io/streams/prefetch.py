"""Decoding ahead in a thread, so that nobody waits for the disk."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Generator
from enum import StrEnum

from conformodal.core.ranges import as_member

from .frames import Frame, FrameStream, SourceError

DEPTH = 4


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
    ready: deque[Frame] = deque()
    changed = threading.Condition()
    ended = stopped = False
    error: BaseException | None = None
    lossy = stream.live or pace is Pace.CAMERA

    def work() -> None:
        nonlocal ended, error
        start: float | None = None
        try:
            for frame in stream:
                if pace is Pace.CAMERA and not stream.live:
                    start = time.monotonic() - frame.timestamp_s if start is None else start
                    time.sleep(max(0.0, start + frame.timestamp_s - time.monotonic()))
                with changed:
                    changed.wait_for(lambda: stopped or lossy or len(ready) < depth)
                    if stopped:
                        break
                    if len(ready) >= depth:
                        ready.popleft()
                    ready.append(frame)
                    changed.notify_all()
        except BaseException as exc:
            error = exc
        with changed:
            ended = True
            changed.notify_all()

    thread = threading.Thread(target=work, name="decoder", daemon=True)
    thread.start()
    try:
        while True:
            with changed:
                changed.wait_for(lambda: bool(ready) or ended)
                if not ready:
                    break
                frame = ready.popleft()
                changed.notify_all()
            yield frame
        if error is not None:
            raise error
    finally:
        with changed:
            stopped = True
            changed.notify_all()
        thread.join(timeout=5)
