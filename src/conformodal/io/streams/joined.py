"""Several sources as one stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from conformodal.geometry import PinholeCamera
from conformodal.io.joining import join_recordings
from conformodal.io.reading import BETWEEN_RECORDINGS_S

from .frames import Frame, FrameStream, SourceError
from .stored import SequenceStream


@dataclass(frozen=True, eq=False)
class JoinedStream:
    """Streams one after the other, whose recordings are numbered on; one whose time goes back begins 10 s later."""

    streams: tuple[FrameStream, ...]
    live = False

    @property
    def name(self) -> str:
        """All of their names."""
        return " + ".join(stream.name for stream in self.streams)

    @property
    def camera(self) -> PinholeCamera | None:
        """Of the first that knows it."""
        return next((stream.camera for stream in self.streams if stream.camera is not None), None)

    @property
    def n_frames(self) -> int | None:
        """Of all, or None where one does not know."""
        counts = [stream.n_frames for stream in self.streams]
        return None if None in counts else sum(count or 0 for count in counts)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame."""
        end, number = float("-inf"), 0
        for stream in self.streams:
            last, latest, start = number, end, None
            for frame in stream:
                if start is None:
                    start = 0.0 if frame.timestamp_s > end else end + BETWEEN_RECORDINGS_S - frame.timestamp_s
                its = replace(
                    frame, timestamp_s=frame.timestamp_s + start, recording=number + frame.recording, index=-1
                )
                last, latest = max(last, its.recording), max(latest, its.timestamp_s)
                yield its
            end, number = latest, last + 1


def join_streams(streams: list[FrameStream]) -> FrameStream:
    """One stream from at least one; data sets alone become one data set, with their poses.

    Raises
    ------
    SourceError
        If one of several never ends.
    DatasetError
        If data sets cannot be joined.
    """
    if len(streams) == 1:
        return streams[0]
    for stream in streams:
        if stream.live:
            raise SourceError(f"{stream.name}: never ends, so it cannot be one of several sources")
    stored = [stream for stream in streams if isinstance(stream, SequenceStream)]
    if len(stored) == len(streams):
        return SequenceStream(join_recordings([stream.sequence for stream in stored]))
    return JoinedStream(tuple(streams))
