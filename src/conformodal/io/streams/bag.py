"""ROS 1 bags, ROS 2 bags and MCAP files, through rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import AnyCamera, Fisheye, view_as
from conformodal.io.cameras import Size
from conformodal.io.reading import Note

from .frames import Frame, SourceError, check_size
from .ros_messages import (
    COMPRESSED,
    INFO,
    RAW,
    camera_of_info,
    encoding_of,
    image_of,
    is_calibrated,
    is_swapped,
    key_of_info,
    stamp_s,
    white_of,
)

SUFFIXES = (".bag", ".mcap", ".db3", ".bag.active")
_REPAIRS = {  # of recordings that were never closed
    ".mcap": "; if it was never closed, repair it with 'mcap recover IN.mcap -o OUT.mcap'",
    ".bag": "; if it was never closed, repair it with 'rosbag reindex'",
    ".active": "; it was never closed: call it .bag, and repair it with 'rosbag reindex'",
}
_FIRST_MESSAGES = 12  # that tell what a recording holds
_SET_BACK_S, _SET_AHEAD_S = 1.0, 60.0  # a clock that jumps by more was set


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS recording: a bag file, or a folder with ``metadata.yaml``."""
    return path.name.lower().endswith(SUFFIXES) or (path.is_dir() and (path / "metadata.yaml").is_file())


@dataclass
class _Clock:
    """The times of a recording by the stamps of its messages, some of which may be wrong; the clock may be set."""

    offset_s: float  # of the stamps' clock to that of reception, by the last message
    time_s: float = -np.inf  # of the last message
    recording: int = 0  # of the last message: where the clock is set, another begins
    _shift_s: float = 0.0
    _received_s: float = 0.0
    _stray_s: float | None = None  # stamp of the message before, if it strayed

    def take(self, stamp_s: float, received_s: float) -> bool:
        """Take up a message; whether its stamp is a time. A second stray one that follows the first is one again."""
        jump_s = stamp_s - received_s - self.offset_s
        if abs(jump_s) > _SET_AHEAD_S or stamp_s + self._shift_s < self.time_s - _SET_BACK_S:
            if self._stray_s is None or not 0 < stamp_s - self._stray_s < _SET_AHEAD_S:
                self._stray_s = stamp_s
                first = not np.isfinite(self.time_s)
                self.time_s = received_s + self.offset_s if first else self.time_s + 1e-3
                return False
            self.recording += 1
            if stamp_s + self._shift_s <= self.time_s:
                self._shift_s = self.time_s + max(received_s - self._received_s, 1e-3) - stamp_s
        self.offset_s, self._stray_s, self._received_s = stamp_s - received_s, None, received_s
        self.time_s = stamp_s + self._shift_s
        return True


class _Message(NamedTuple):
    """An image as it was sent."""

    content: Any
    kind: str
    stamp_s: float
    received_s: float


@dataclass(frozen=True)
class BagStream:
    """Images of one topic of a recording, as :func:`open_bag` opens it."""

    path: Path
    topic: str
    camera: PinholeCamera | None  # that images are brought to, where the recording has any; else theirs, if known
    n_frames: int
    notes: tuple[Note, ...]
    received: bool  # whether times are those of reception, as the headers have no stamps
    offset_s: float  # of the headers' clock to that of reception, in the first messages
    info_topic: str | None  # of the ``CameraInfo``
    lens: AnyCamera | None  # what it says
    live = False

    @property
    def name(self) -> str:
        """The file's, and the topic."""
        return f"{self.path.name} {self.topic}"

    def __iter__(self) -> Iterator[Frame]:
        """Decode message after message; one that cannot be decoded, or whose time strays, comes without an image.

        A clock that is set begins a new recording, whose times follow those before; another camera ends the stream.
        """
        clock, white = _Clock(self.offset_s), 0
        for number, message in enumerate(self._messages()):
            place = f"{self.path}, message {number} of {self.topic}"
            image, problem = None, ""
            if clock.take(message.stamp_s, message.received_s):
                try:
                    white = max(white, white_of(message.content))
                    image = image_of(message.content, message.kind, white)
                    if self.camera is not None and self.lens is not None:
                        image = view_as(image, self.lens, self.camera)
                except ValueError as exc:
                    image, problem = None, f"{place}: {exc}"
            else:
                problem = f"{place}: its stamp, {message.stamp_s:.3f} s, is far from those of its neighbours"
            yield Frame(f"{self.path.stem}-{number:06d}", clock.time_s, image, problem, clock.recording)

    def _messages(self) -> Iterator[_Message]:
        """The images as they were sent, by one camera."""
        n_images, camera = 0, ""
        with bag_reader(self.path) as reader:
            wanted = [c for c in reader.connections if c.topic in (self.topic, self.info_topic)]
            try:
                for connection, received_ns, raw in reader.messages(connections=wanted):
                    message = reader.deserialize(raw, connection.msgtype)
                    if connection.msgtype != INFO:
                        stamp = received_ns / 1e9 if self.received else stamp_s(message)
                        yield _Message(message, connection.msgtype, stamp, received_ns / 1e9)
                        n_images += 1
                    elif is_calibrated(message):
                        if camera not in ("", key_of_info(message)):
                            raise ValueError(f"{self.info_topic} gives another camera; split the recording there")
                        camera = key_of_info(message)
            except Exception as exc:  # damaged bytes lead a decoder to any error
                raise SourceError(f"{self.path}: breaks off after {n_images} images: {exc}") from exc


def open_bag(path: Path, topic: str | None = None, camera: PinholeCamera | None = None) -> BagStream:
    """Open a recording.

    Parameters
    ----------
    path
        A ROS 1 bag, a ROS 2 folder, or the file in it.
    topic
        Of the images; may be left out if there is only one.
    camera
        Of a recording without a ``CameraInfo``; its images must have this size.

    Raises
    ------
    SourceError
        If the recording is missing, damaged or without images that can be decoded.
    MissingPackageError
        If rosbags is not installed.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such recording")
    notes: list[Note] = []
    with bag_reader(path) as reader:
        images = [c for c in reader.connections if c.msgtype in (RAW, COMPRESSED) and c.msgcount]
        topics = sorted({c.topic for c in images})
        if not topics:
            others = sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})
            raise SourceError(f"{path}: holds no images; its topics are {', '.join(others) or 'none'}")
        if topic is None and len(topics) > 1:
            raise SourceError(f"{path}: holds several image topics, name one of {', '.join(topics)}")
        topic = topics[0] if topic is None else topic
        if topic not in topics:
            raise SourceError(f"{path}: holds no images on {topic}; there are {', '.join(topics)}")
        connections = [c for c in images if c.topic == topic]
        times, size = _first_messages(reader, connections, f"{path}: {topic}", notes)
        stamps = times[:, 0]
        received = 2 * (stamps == 0).sum() > len(stamps) or (len(stamps) > 1 and len(np.unique(stamps)) == 1)
        if received:
            notes.append(Note("no header stamps", f"{path}: {topic}: times are those of reception"))
        calibration = _calibration(reader, path, topic, size, notes)
        if calibration is None:
            check_size(f"{path}: {topic}", size, camera)
        else:
            camera = calibration.lens.pinhole if isinstance(calibration.lens, Fisheye) else calibration.lens
    return BagStream(
        path,
        topic,
        camera,
        n_frames=sum(c.msgcount for c in connections),
        notes=tuple(notes),
        received=bool(received),
        offset_s=0.0 if received or not len(times) else float(np.median(times[:3, 0] - times[:3, 1])),
        info_topic=calibration and calibration.topic,
        lens=calibration and calibration.lens,
    )


def _first_messages(
    reader: Any, connections: list[Any], place: str, notes: list[Note]
) -> tuple[FloatArray, Size | None]:
    """Stamps and times of reception (n, 2) of the first messages, and their size if it is known.

    Refuses images that cannot be decoded.
    """
    times, size, fault, white = list[tuple[float, float]](), None, "", 0
    for connection, received_ns, raw in islice(reader.messages(connections=connections), _FIRST_MESSAGES):
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as exc:  # damaged bytes lead it to any error
            text = "cannot be decoded; if metadata.yaml says that messages are compressed, name the folder of both"
            raise SourceError(f"{place}: {text}: {exc}") from exc
        times.append((stamp_s(message), received_ns / 1e9))
        if connection.msgtype == RAW:
            encoding_of(message, place)
        elif is_swapped(message.format):
            notes.append(Note("red and blue are swapped", f"{place}: as image_transport does for {message.format!r}"))
        try:
            white = max(white, white_of(message))
            height, width = image_of(message, connection.msgtype).shape[:2]
            size = size or (width, height)
        except ValueError as exc:
            fault = fault or str(exc)
    if fault and size is None and connections[0].msgtype == COMPRESSED:
        raise SourceError(f"{place}: {fault}")
    if white > 255:
        notes.append(Note("16-bit images", f"{place}: {white} of 65535 is shown as white"))
    return np.array(times).reshape(-1, 2), size


class _Calibration(NamedTuple):
    topic: str
    lens: AnyCamera


def _calibration(reader: Any, path: Path, topic: str, size: Size | None, notes: list[Note]) -> _Calibration | None:
    """The first calibrated CameraInfo in the images' name space; of several cameras, the most alike by name."""
    space = topic.removesuffix("/compressed").rpartition("/")[0]
    infos = [c for c in reader.connections if c.msgtype == INFO]
    beside = {c.topic for c in infos if c.topic.rpartition("/")[0] == space}
    likeness = {name: (_n_alike(topic, name), name.endswith("camera_info")) for name in sorted(beside)}
    nearest = max(likeness, key=lambda name: likeness[name], default=None)
    uncalibrated = ""
    for connection, _, raw in reader.messages(connections=[c for c in infos if c.topic == nearest]) if nearest else ():
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as exc:  # as above
            raise SourceError(f"{path}: {nearest} cannot be decoded: {exc}") from exc
        if is_calibrated(message):
            return _Calibration(connection.topic, camera_of_info(message, f"{path}: {nearest}", topic, size, notes))
        uncalibrated = f"; {nearest} has zeros"
    others = ", ".join(sorted({c.topic for c in infos} - {nearest})) or "none"
    where = f"{path}: {topic}: its camera is not known{uncalibrated}; in other name spaces: {others}"
    notes.append(Note("no CameraInfo", where))
    return None


def _n_alike(one: str, other: str) -> int:
    """How many letters two names have in common at their beginnings."""
    return next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))


@contextmanager
def bag_reader(path: Path) -> Iterator[Any]:
    """An open reader."""
    with require_extra("ros", f"{path}: a ROS recording"):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as exc:  # damaged bytes lead it to any error
        hint = _REPAIRS.get(path.suffix, "") if path.stat().st_size else ""
        raise SourceError(f"{path}: cannot be opened as a ROS recording: {exc}{hint}") from exc
    with closing(reader):
        yield reader
