"""ROS 1 bags, ROS 2 bags and MCAP files, through rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera
from conformodal.io.diagnosis.recordings import describe_unopened
from conformodal.io.errors import DatasetError
from conformodal.io.reading import Note

from .frames import Frame, SourceError, check_size
from .ros_messages import COMPRESSED, INFO, RAW, camera_of_info, image_of, is_calibrated, key_of_info, stamp_s

SUFFIXES = (".bag", ".mcap", ".db3", ".bag.active")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS recording: a bag file, or a folder with ``metadata.yaml``."""
    return path.name.lower().endswith(SUFFIXES) or (path.is_dir() and (path / "metadata.yaml").is_file())


@dataclass(frozen=True)
class BagStream:
    """Images of one topic of a recording, as :func:`open_bag` opens it."""

    path: Path
    topic: str
    camera: PinholeCamera | None
    n_frames: int
    notes: tuple[Note, ...]
    received: bool  # whether times are those of reception, as the headers have no stamps
    info_topic: str | None = None  # of the ``CameraInfo``
    live = False

    @property
    def name(self) -> str:
        """The file's, and the topic."""
        return f"{self.path.name} {self.topic}"

    def __iter__(self) -> Iterator[Frame]:
        """Decode message after message; one that cannot be decoded comes without an image.

        A :class:`SourceError` ends it where messages are damaged, or another camera begins.
        """
        number, camera = 0, ""
        with bag_reader(self.path) as reader:
            wanted = [c for c in reader.connections if c.topic in (self.topic, self.info_topic)]
            try:
                for connection, received_ns, raw in reader.messages(connections=wanted):
                    message = reader.deserialize(raw, connection.msgtype)
                    if connection.msgtype != INFO:
                        yield self._frame(message, connection.msgtype, received_ns / 1e9, number)
                        number += 1
                    elif is_calibrated(message):
                        if camera not in ("", key_of_info(message)):
                            raise ValueError(f"{self.info_topic} gives another camera; split the recording there")
                        camera = key_of_info(message)
            except Exception as exc:  # damaged bytes lead a decoder to any error
                raise SourceError(f"{self.path}: breaks off after {number} images: {exc}") from exc

    def _frame(self, message: Any, kind: str, received_s: float, number: int) -> Frame:
        image, problem = None, ""
        try:
            image = image_of(message, kind)
        except DatasetError as exc:
            problem = f"{self.path}, message {number} of {self.topic}: {exc}"
        time_s = received_s if self.received else stamp_s(message)
        return Frame(f"{self.path.stem}-{number:06d}", time_s, image, problem)


def open_bag(path: Path, topic: str | None = None, camera: PinholeCamera | None = None) -> BagStream:
    """Open a ROS 1 bag, a ROS 2 folder, or the file in it; `topic` is needed where several have images.

    `camera` is that of a recording without a ``CameraInfo``, whose images must have its size.
    """
    if not (path.is_file() or path.is_dir()):
        raise SourceError(f"{path}: no such recording")
    notes: list[Note] = []
    with bag_reader(path) as reader:
        images = [c for c in reader.connections if c.msgtype in (RAW, COMPRESSED) and c.msgcount]
        topics = sorted({c.topic for c in images})
        if not topics:
            others = sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})
            raise SourceError(f"{path}: holds no images; its topics are {', '.join(others) or 'none'}")
        if (topic is None and len(topics) > 1) or topic not in (None, *topics):
            raise SourceError(f"{path}: holds images on {', '.join(topics)}; name one of these topics, got {topic}")
        topic = topic or topics[0]
        connections = [c for c in images if c.topic == topic]
        kind, message = _first(reader, connections, f"{path}: {topic}")
        try:
            height, width = image_of(message, kind).shape[:2]
        except DatasetError as exc:
            raise SourceError(f"{path}: {topic}: {exc}") from exc
        if received := stamp_s(message) == 0:
            notes.append(Note("no header stamps", f"{path}: {topic}: times are those of reception"))
        info_topic, info = _camera_info(reader, path, topic, notes)
        if info is None:
            check_size(f"{path}: {topic}", (width, height), camera)
        else:
            camera = camera_of_info(info, f"{path}: {info_topic}", topic, (width, height), notes)
    n_frames = sum(c.msgcount for c in connections)
    return BagStream(path, topic, camera, n_frames, tuple(notes), received, info_topic)


def _camera_info(reader: Any, path: Path, topic: str, notes: list[Note]) -> tuple[str | None, Any]:
    """The topic and first message of ``camera_info`` beside the images, or of the only CameraInfo in their name space.

    None where there is none, or a driver without a calibration sends zeros, which is noted.
    """
    space = topic.removesuffix("/compressed").rpartition("/")[0]
    infos = [c for c in reader.connections if c.msgtype == INFO and c.msgcount]
    beside = sorted({c.topic for c in infos if c.topic.rpartition("/")[0] == space})
    usual = f"{space}/camera_info"
    name = usual if usual in beside else beside[0] if len(beside) == 1 else None
    if name is not None:
        _, message = _first(reader, [c for c in infos if c.topic == name], f"{path}: {name}")
        if is_calibrated(message):
            return name, message
    there = ", ".join(sorted({c.topic for c in infos})) or "none"
    zeros = f"; {name} has zeros" if name else ""
    where = f"{path}: {topic}: its camera is not known, expected {usual}{zeros}; there are {there}"
    notes.append(Note("no CameraInfo", where))
    return None, None


def _first(reader: Any, connections: list[Any], place: str) -> tuple[str, Any]:
    """Type and content of the first message."""
    try:
        connection, _, raw = next(reader.messages(connections=connections))
        return connection.msgtype, reader.deserialize(raw, connection.msgtype)
    except Exception as exc:  # damaged bytes lead it to any error
        text = "cannot be decoded; if metadata.yaml says that messages are compressed, name the folder of both"
        raise SourceError(f"{place}: {text}: {exc}") from exc


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
        what = f"cannot be opened as a ROS recording: {str(exc).rstrip('.')}{describe_unopened(path)}"
        raise SourceError(f"{path}: {what}") from exc
    with closing(reader):
        yield reader
