"""Video files and cameras, through OpenCV."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.io.decoding import TURNED
from conformodal.io.errors import DatasetWarning
from conformodal.io.reading import Note

from .frames import Frame, SourceError, check_size

# Containers count frames roughly; fewer than this share of them is a file that was cut off.
_WHOLE = 0.98
_PACKETS = ((0, 188), (4, 192))  # of a transport stream: where the first starts, and bytes; times go before some
_ROUGH = (".mkv", ".webm", ".ts", ".mts", ".m2ts")  # count frames by what lasts longest
_LISTS = (b"ffconcat", b"#EXTM3U", b"v=0", b"<?xml", b"<MPD")  # which lead to other files, or onto a network
_UNTIMED = (".h264", ".264", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg")  # pictures without a container


def _rgb(image: AnyArray) -> UInt8Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _is_whole(path: Path) -> bool:
    """Whether the parts of an MP4, MOV, AVI or Matroska file have the sizes that they say, so that it was not cut off.

    Of such a file an edit list may show fewer frames than there are, and others count what lasts longer, such as sound.
    A transport stream does not state sizes.
    """
    with path.open("rb") as file:
        end, at = file.seek(0, 2), 0
        file.seek(0)
        head = file.read(200)
        if head[:4] == b"RIFF":
            return int.from_bytes(head[4:8], "little") + 8 <= end
        if head[:4] == b"\x1aE\xdf\xa3":
            file.seek(4)
            file.seek(_size(file), 1)  # to the segment, which holds everything
            return file.read(4) == b"\x18S\x80g" and _size(file) + file.tell() <= end
        while head[4:8] == b"ftyp" and at < end:
            file.seek(at)
            size, large = int.from_bytes(file.read(4)), int.from_bytes(file.read(12)[4:])
            at += max({0: end - at, 1: large}.get(size, size), 8)  # to the end of the file, or in 64 bits
    return at == end or any(head[k : k + 1] == b"G" == head[k + n : k + n + 1] for k, n in _PACKETS)


def _parts(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Names of the parts of an MP4 or MOV file, and where their contents start and end."""
    while start + 8 <= end:
        file.seek(start)
        size, name, large = int.from_bytes(file.read(4)), file.read(4), int.from_bytes(file.read(8))
        after = start + max({0: end - start, 1: large}.get(size, size), 8)
        yield name, start + (16 if size == 1 else 8), min(after, end)
        start = after


def _is_mirrored(path: Path) -> bool:
    """Whether an MP4 or MOV file says that its pictures are shown mirrored, which OpenCV does not do."""
    with path.open("rb") as file:

        def determinant(start: int, at: int) -> int:
            """Of the display matrix of a header, which is 12 bytes later where times have 64 bits."""
            file.seek(start)
            file.seek(start + at + 12 * (file.read(1) or b"\0")[0])  # nothing at the end of a damaged file
            a, b, _, c, d = (int.from_bytes(file.read(4), signed=True) for _ in range(5))
            return a * d - b * c

        end = file.seek(0, 2)
        file.seek(4)
        if file.read(4) != b"ftyp":
            return False
        movie = [part for name, *its in _parts(file, 0, end) if name == b"moov" for part in _parts(file, *its)]
        whole = [determinant(start, 36) for name, start, _ in movie if name == b"mvhd"]
        for track in ({name: its for name, *its in _parts(file, *its)} for name, *its in movie if name == b"trak"):
            media = {name: start for name, start, _ in _parts(file, *track.get(b"mdia", (0, 0)))}
            file.seek(media.get(b"hdlr", end) + 8)
            if file.read(4) == b"vide" and b"tkhd" in track:
                return determinant(track[b"tkhd"][0], 40) * (whole or [1])[0] < 0
    return False


def _size(file: BinaryIO) -> int:
    """Size of a part of a Matroska file, in as many bytes as the first says; 0 where it is not known."""
    first = (file.read(1) or b"\0")[0]
    more = 8 - first.bit_length()
    value = int.from_bytes(bytes([first & (127 >> more)]) + file.read(more))
    return 0 if value == (1 << 7 * (more + 1)) - 1 else value


@dataclass(frozen=True)
class VideoStream:
    """A video file; a :class:`SourceError` if it is missing, not a video, or shown mirrored.

    Attributes
    ----------
    path
        The file. Times are those of its frames, from its start.
    camera
        Intrinsics; None where they are known elsewhere.
    notes
        Whether its images are turned, its pixels not square, and whether it has no times.
    """

    path: Path
    camera: PinholeCamera | None = None
    notes: tuple[Note, ...] = ()
    live = False

    def __post_init__(self) -> None:
        if not self.path.is_file():
            raise SourceError(f"{self.path}: no such video")
        with self.path.open("rb") as file:
            if (head := file.read(8)).startswith(_LISTS):
                raise SourceError(
                    f"{self.path}: is a list of other files ({head.decode('ascii', 'replace')}...), expected a video"
                )
        with self._open() as capture:
            turned = capture.get(cv2.CAP_PROP_ORIENTATION_META)
            sides = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
            rate = capture.get(cv2.CAP_PROP_FPS)
            shape = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
        if _is_mirrored(self.path) or turned % 90:
            how = f"turned by {turned:.0f} degrees" if turned % 90 else "mirrored"
            raise SourceError(
                f"{self.path}: its metadata says that pictures are shown {how}, and only quarter turns are applied; "
                "write them as they are shown, such as by 'ffmpeg -i IN.mp4 OUT.mp4'"
            )
        notes = list[Note]()
        check_size(str(self.path), (int(sides[0]), int(sides[1])) if all(sides) else None, self.camera)
        if turned:
            where = f"{self.path}: by {turned:.0f} degrees, as its metadata says; intrinsics must be those after"
            notes.append(Note(TURNED, where))
        if all(shape) and shape[0] != shape[1]:
            where = (
                f"{self.path}: {shape[0]:.0f}:{shape[1]:.0f}; intrinsics must be those of the pixels as they are stored"
            )
            notes.append(Note("pixels are not square", where))
        if self.path.suffix.lower() in _UNTIMED:
            where = f"{self.path}: {rate:g} frames per second are assumed; a container, such as MP4, has their times"
            notes.append(Note("no times", where))
        object.__setattr__(self, "notes", tuple(notes))

    @property
    def name(self) -> str:
        """The file's."""
        return self.path.name

    @property
    def n_frames(self) -> int | None:
        """As the container says."""
        with self._open() as capture:
            return int(max(capture.get(cv2.CAP_PROP_FRAME_COUNT), 0)) or None

    @contextmanager
    def _open(self) -> Iterator[cv2.VideoCapture]:
        capture = cv2.VideoCapture(os.path.abspath(self.path))  # what stands before a colon is taken for a protocol
        try:
            if not capture.isOpened():
                raise SourceError(f"{self.path}: cannot be opened as a video")
            yield capture
        finally:
            capture.release()

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame; a :class:`SourceError` if there are fewer than the file claims."""
        with self._open() as capture:
            rate, claimed = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
            done, last = 0, -np.inf
            while True:
                there, image = capture.read()
                if not there:
                    break
                stated = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000  # of the frame just read, where the file says it
                last = stated if stated > last or not rate > 0 else last + 1 / rate
                yield Frame(f"{self.path.stem}-{done:06d}", last, _rgb(image))
                done += 1
        if done >= max(_WHOLE * claimed - 1, 1):
            return
        if claimed <= 0:
            raise SourceError(f"{self.path}: holds no frame that can be decoded as a video")
        ends = f"{self.path}: ends after {done} of {claimed:.0f} frames"
        if done == 0 or not _is_whole(self.path):
            raise SourceError(f"{ends}; the file was cut off")
        if self.path.suffix.lower() in _ROUGH:
            warnings.warn(f"{ends}: its sound is longer, or the file is damaged", DatasetWarning, stacklevel=2)


@dataclass(frozen=True)
class CameraStream:
    """A camera of this machine, until it is gone: a :class:`SourceError`.

    Attributes
    ----------
    index
        Which one, from 0. Times are those of the clock when a frame arrives.
    camera
        Intrinsics; None where they are known elsewhere.
    """

    index: int
    camera: PinholeCamera | None = None
    live = True
    n_frames = None

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
            for done in count():
                there, image = capture.read()
                if not there:
                    raise SourceError(f"{self.name}: gives no more frames after {done}; was it unplugged?")
                yield Frame(f"camera{self.index}-{done:06d}", time.time(), _rgb(image))
        finally:
            capture.release()
