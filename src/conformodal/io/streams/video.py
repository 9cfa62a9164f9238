"""Video files and cameras, through OpenCV."""

from __future__ import annotations

import os
import re
import struct
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.io.decoding import TURNED
from conformodal.io.errors import DatasetWarning
from conformodal.io.reading import Note

from .frames import Frame, SourceError, check_size

_COUNTED, _WHOLE = (".avi", ".mp4", ".mov", ".m4v"), 0.98  # other containers than these count frames roughly
_MAX_DAMAGED = 30  # frames in a row; at its end a file fails for good
_LISTS = (b"ffconcat", b"#EXTM3U", b"v=0", b"<?xml", b"<MPD")  # which lead to other files, or onto a network
_UNTIMED = (".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg")  # pictures without a container


def _rgb(image: AnyArray) -> UInt8Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _is_mirrored(path: Path) -> bool:
    """Whether an MP4 or MOV file shows a track mirrored by the matrix in its header, which OpenCV passes over."""
    with path.open("rb") as file:
        while len(head := file.read(16)) == 16:
            n_bytes = int.from_bytes(head[8:] if head[:4] == b"\0\0\0\1" else head[:4])
            if n_bytes < 8:
                return False
            if head[4:8] == b"moov":
                movie = head[8:] + file.read(n_bytes - 16) + bytes(99)
                for match in re.finditer(rb"mvhd|tkhd", movie):
                    at = match.end() + (36 if match[0] == b"mvhd" else 40) + 12 * (movie[match.end()] == 1)
                    a, b, _, c, d = struct.unpack_from(">5i", movie, at)
                    if a * d < b * c:
                        return True
                return False
            file.seek(n_bytes - 16, 1)
    return False


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(os.path.abspath(path))  # what stands before a colon is taken for a protocol
    try:
        if not capture.isOpened():
            why = "is it cut off (an MP4 then lacks its index), or packed? Copy it again, or unpack it"
            raise SourceError(f"{path}: cannot be opened as a video; {why}")
        yield capture
    finally:
        capture.release()


def open_video(path: Path, camera: PinholeCamera | None = None) -> VideoStream:
    """A video file; a :class:`SourceError` if it is not a video, or shown aslant or mirrored."""
    with path.open("rb") as file:
        if (head := file.read(8)).startswith(_LISTS):
            raise SourceError(f"{path}: is a list of other files ({head.decode('ascii', 'replace')}...), not a video")
    with _opened(path) as capture:
        turned_deg = capture.get(cv2.CAP_PROP_ORIENTATION_META)
        size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate_hz, n_frames = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        pixel = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if turned_deg % 90 or _is_mirrored(path):
        how = f"turned by {turned_deg:.0f} degrees" if turned_deg % 90 else "mirrored"
        raise SourceError(f"{path}: is shown {how}, and only quarter turns are read; try 'ffmpeg -i IN.mp4 OUT.mp4'")
    check_size(str(path), size if all(size) else None, camera)
    notes = []
    if turned_deg:
        where = f"{path}: by {turned_deg:.0f} degrees, as its metadata says; intrinsics must be those after"
        notes.append(Note(TURNED, where))
    if all(pixel) and pixel[0] != pixel[1]:
        where = f"{path}: {pixel[0]:.0f}:{pixel[1]:.0f}; intrinsics must be those of the pixels as they are stored"
        notes.append(Note("pixels are not square", where))
    if path.suffix.lower() in _UNTIMED:
        where = f"{path}: {rate_hz:g} frames per second are assumed; a container, such as MP4, has their times"
        notes.append(Note("no times", where))
    return VideoStream(path, camera, n_frames if n_frames > 0 else None, tuple(notes))


@dataclass(frozen=True)
class VideoStream:
    """A video file, as :func:`open_video` opens it; times are those of its frames, from its start."""

    path: Path
    camera: PinholeCamera | None  # None where it is known elsewhere
    n_frames: int | None  # as the container says; None if it does not
    notes: tuple[Note, ...]
    live = False

    @property
    def name(self) -> str:
        """The file's."""
        return self.path.name

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; one that cannot be decoded comes without an image.

        Fewer frames than the file claims are a warning.
        """
        with _opened(self.path) as capture:
            rate_hz, last_s, done, damaged = capture.get(cv2.CAP_PROP_FPS), -np.inf, 0, 0
            while damaged < _MAX_DAMAGED:
                there, image = capture.read()
                if not there:
                    damaged += 1
                    continue
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000  # where the file has it
                if time_s <= last_s and rate_hz > 0:
                    time_s = last_s + (damaged + 1) / rate_hz
                before_s = last_s if done else time_s - (damaged + 1) / max(rate_hz, 1.0)
                for between_s in np.linspace(before_s, time_s, damaged + 2)[1:-1].tolist():
                    problem = f"{self.path}: frame {done} cannot be decoded"
                    yield Frame(f"{self.path.stem}-{done:06d}", between_s, None, problem)
                    done += 1
                yield Frame(f"{self.path.stem}-{done:06d}", time_s, _rgb(image))
                last_s, done, damaged = time_s, done + 1, 0
        if not done:
            raise SourceError(f"{self.path}: holds no frame that can be decoded as a video")
        exact = self.path.suffix.lower() in _COUNTED
        if self.n_frames and done < (self.n_frames if exact else _WHOLE * self.n_frames - 1):
            ends = f"{self.path}: ends after {done} of {self.n_frames} frames; was it cut off, trimmed or damaged?"
            warnings.warn(ends, DatasetWarning, stacklevel=2)


@dataclass(frozen=True)
class CameraStream:
    """A camera of this machine by its number, until it is gone: a :class:`SourceError`; times are of the clock."""

    index: int
    camera: PinholeCamera | None = None
    live = True
    n_frames = None
    notes = ()

    @property
    def name(self) -> str:
        """For people."""
        return f"camera {self.index}"

    def __iter__(self) -> Iterator[Frame]:
        """Take frame after frame."""
        capture = cv2.VideoCapture(self.index)
        try:
            if not capture.isOpened():
                raise SourceError(f"{self.name}: cannot be opened; is it plugged in, and free?")
            if self.camera is not None:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width)
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height)
            # the wall clock may be set back or forth while the camera runs
            started_s = time.time() - time.monotonic()
            for done in count():
                there, image = capture.read()
                if not there:
                    raise SourceError(f"{self.name}: gives no more frames after {done}; was it unplugged?")
                yield Frame(f"camera{self.index}-{done:06d}", started_s + time.monotonic(), _rgb(image))
        finally:
            capture.release()
