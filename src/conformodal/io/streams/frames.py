"""One frame of a stream, and what a stream is; a data set as a stream, several streams as one, and decoding ahead."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Protocol

from conformodal.core.arrays import IntArray, UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import view_as
from conformodal.io.diagnosis.stale import RepeatWatch
from conformodal.io.errors import DatasetError, ImageError
from conformodal.io.reading import Note
from conformodal.io.recording import Recording, join_recordings

DEPTH = 4
_WAIT_S = 0.1  # after which the thread looks whether its taker has gone


class SourceError(DatasetError):
    """A source that cannot be opened, or that ends where it should not; what came before it is sound."""


def check_size(place: str, size: tuple[int, int] | None, camera: PinholeCamera | None) -> None:
    """Refuse images of another size than the camera's that a source without calibration is assumed to have."""
    if size and camera is not None and size != (camera.width, camera.height):
        expected = f"expected the model's {camera.width}x{camera.height}; give --camera or --focal"
        raise SourceError(f"{place}: has images of {size[0]}x{size[1]} pixels and no calibration, {expected}")


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as a camera delivers it.

    The image (height, width, 3) is RGB, or None where it could not be had; `problem` says why. Motion is never linked
    across recordings. A frame without `answer` only leads from one to the next. `index` is its place in a data set.
    """

    name: str
    timestamp_s: float
    image: UInt8Array | None
    problem: str = ""
    recording: int = 0
    answer: bool = True
    index: int = -1


class FrameStream(Protocol):
    """Frames in order of time.

    Iterating decodes one after the other, closes at its end what it holds open, and raises :class:`SourceError` where
    the source breaks off.
    """

    @property
    def name(self) -> str:
        """For people."""

    @property
    def camera(self) -> PinholeCamera | None:
        """Intrinsics, where the source knows them."""

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is unlikely, left out or assumed."""

    @property
    def n_frames(self) -> int | None:
        """Frames to come, or None where nobody knows."""

    @property
    def live(self) -> bool:
        """Whether frames that are not taken in time are lost."""

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame."""


class ConvertedStream:
    """A source whose images come as another camera would have seen them."""

    def __init__(self, source: FrameStream, lens: PinholeCamera, camera: PinholeCamera) -> None:
        self.source, self.lens, self.camera = source, lens, camera
        self.name, self.notes, self.n_frames, self.live = source.name, source.notes, source.n_frames, source.live

    def __iter__(self) -> Iterator[Frame]:
        """Decode and convert frame after frame."""
        for frame in self.source:
            image = None if frame.image is None else view_as(frame.image, self.lens, self.camera)
            yield replace(frame, image=image)


@dataclass(frozen=True, eq=False)
class RecordingStream:
    """Frames of a data set; those that want no answer come too, for the tracker."""

    sequence: Recording
    frames: IntArray | None = None  # increasing indices of those that want an answer; None for all
    live = False

    @property
    def name(self) -> str:
        """The data set's."""
        return self.sequence.name

    @property
    def camera(self) -> PinholeCamera:
        """The data set's."""
        return self.sequence.camera

    @property
    def notes(self) -> tuple[Note, ...]:
        """The data set's."""
        return self.sequence.notes

    @property
    def n_frames(self) -> int:
        """Frames to come, those between included."""
        return len(self._span())

    def _span(self) -> range:
        if self.frames is None:
            return range(len(self.sequence))
        return range(int(self.frames.min()), int(self.frames.max()) + 1) if self.frames.size else range(0)

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; one that cannot be decoded comes without an image."""
        wanted = set(self._span() if self.frames is None else self.frames.tolist())
        names = frame_names(self.sequence.image_paths)
        for i in self._span():
            image, problem = None, ""
            try:
                image = self.sequence.image(i)
            except ImageError as exc:
                problem = str(exc)
            time_s, recording = float(self.sequence.timestamps_s[i]), int(self.sequence.recording[i])
            yield Frame(names[i], time_s, image, problem, recording, i in wanted, i)


def frame_names(paths: Sequence[Path]) -> list[str]:
    """Names of image files; with their folders where recordings have files of one name."""
    names = [path.name for path in paths]
    if len(set(names)) == len(names):
        return names
    common = os.path.commonpath([os.path.abspath(path.parent) for path in paths])
    return [Path(os.path.relpath(path, common)).as_posix() for path in paths]


def join_streams(streams: Sequence[FrameStream]) -> FrameStream:
    """One stream from data sets, with their poses; another source stays alone."""
    if len(streams) == 1:
        return streams[0]
    data_sets = [stream.sequence for stream in streams if isinstance(stream, RecordingStream)]
    if len(data_sets) < len(streams):
        other = next(stream.name for stream in streams if not isinstance(stream, RecordingStream))
        raise SourceError(f"{other}: is one of several sources, which must be data sets; run it alone, or convert it")
    return RecordingStream(join_recordings(data_sets))


def _without_stale_pictures(stream: FrameStream) -> Iterator[Frame]:
    """Frames of a stream; those whose picture repeats to the last bit after a motion come without it."""
    watch, recording = RepeatWatch(), None
    for frame in stream:
        if frame.recording != recording:
            watch, recording = RepeatWatch(), frame.recording
        if frame.image is not None and (problem := watch.check(frame.image, frame.timestamp_s, frame.name)):
            yield replace(frame, image=None, problem=problem)
        else:
            yield frame


def prefetch(stream: FrameStream, depth: int = DEPTH) -> Generator[Frame]:
    """Frames of a stream, decoded ahead; its :class:`SourceError` comes after all frames before it.

    Stored sources wait when `depth` frames are ready. Of a live source, the oldest frame that was not taken yet is
    lost, as it would be to a robot.
    """
    ready: Queue[Frame | BaseException | None] = Queue(depth)  # None ends it
    stopped = Event()

    def offer(item: Frame | BaseException | None) -> None:
        while not stopped.is_set():
            if stream.live and ready.full():
                with suppress(Empty):
                    ready.get_nowait()
            with suppress(Full):
                return ready.put(item, timeout=_WAIT_S)

    def decode() -> None:
        try:
            for frame in _without_stale_pictures(stream):
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
