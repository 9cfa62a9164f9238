"""ROS 1 bags, ROS 2 bags and MCAP files, through rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera

from ..cameras import UNDISTORT, camera_of, check_matrix
from ..decoding import decode
from ..errors import DatasetError
from .frames import Frame, SourceError

_RAW, _COMPRESSED, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
# encoding: (channels, conversion to RGB or None)
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
_LENSES = ("plumb_bob", "radtan")
SUFFIXES = (".bag", ".mcap", ".db3")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS recording: a bag file, or a folder with ``metadata.yaml``."""
    return path.suffix in SUFFIXES or (path.is_dir() and (path / "metadata.yaml").is_file())


@dataclass(frozen=True)
class BagStream:
    """Images of one topic of a recording.

    Attributes
    ----------
    path
        A ROS 1 bag, a ROS 2 folder, or the file in it (``.mcap``, ``.db3``).
    topic
        Of the images; may be left out if there is only one. Times are those of the messages' headers.
    camera
        Intrinsics; by default those of the first ``CameraInfo`` beside the images.

    Raises
    ------
    SourceError
        If rosbags is not installed, or the recording is missing, damaged or without such images.
    """

    path: Path
    topic: str | None = None
    camera: PinholeCamera | None = None

    def __post_init__(self) -> None:
        if not self.path.exists():
            raise SourceError(f"{self.path}: no such recording")
        with _reader(self.path) as reader:
            images = [c for c in reader.connections if c.msgtype in (_RAW, _COMPRESSED)]
            topics = sorted({c.topic for c in images if c.msgcount})
            if not topics:
                others = sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})
                raise SourceError(f"{self.path}: holds no images; its topics are {', '.join(others) or 'none'}")
            if self.topic is None and len(topics) > 1:
                raise SourceError(f"{self.path}: holds several image topics, name one of {', '.join(topics)}")
            chosen = topics[0] if self.topic is None else self.topic
            if chosen not in topics:
                raise SourceError(f"{self.path}: holds no images on {chosen}; there are {', '.join(topics)}")
            object.__setattr__(self, "topic", chosen)
            if self.camera is None:
                object.__setattr__(self, "camera", self._info(reader))

    @property
    def name(self) -> str:
        """The file's, and the topic."""
        return f"{self.path.name} {self.topic}"

    @property
    def n_frames(self) -> int:
        """Messages of the topic."""
        with _reader(self.path) as reader:
            return sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    @property
    def live(self) -> bool:
        """Files wait."""
        return False

    def __iter__(self) -> Iterator[Frame]:
        """Decode message after message; one that cannot be decoded comes without an image.

        Raises
        ------
        SourceError
            If the recording breaks off.
        """
        done = 0
        with _reader(self.path) as reader:
            wanted = [c for c in reader.connections if c.topic == self.topic]
            messages = iter(reader.messages(connections=wanted))
            while True:
                try:
                    item = next(messages, None)
                    if item is None:
                        return
                    message = reader.deserialize(item[2], item[0].msgtype)
                    stamp = message.header.stamp
                    time_s = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
                except Exception as exc:  # damaged bytes lead a decoder to any error
                    raise SourceError(f"{self.path}: breaks off after {done} images: {exc}") from exc
                image, problem = None, ""
                try:
                    image = _decode(message, item[0].msgtype)
                except ValueError as exc:
                    problem = f"{self.path}, message {done} of {self.topic}: {exc}"
                yield Frame(f"{self.path.stem}-{done:06d}", time_s, image, problem)
                done += 1

    def _info(self, reader: Any) -> PinholeCamera | None:
        """The camera of the first CameraInfo in the images' name space."""
        space = str(self.topic).removesuffix("/compressed").rpartition("/")[0]
        infos = [c for c in reader.connections if c.msgtype == _INFO and c.topic.rpartition("/")[0] == space]
        for connection, _, raw in reader.messages(connections=infos) if infos else ():
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except Exception as exc:  # as above
                raise SourceError(f"{self.path}: {connection.topic} cannot be decoded: {exc}") from exc
            k = np.asarray(message.K if hasattr(message, "K") else message.k, dtype=np.float64)
            d = np.asarray(message.D if hasattr(message, "D") else message.d, dtype=np.float64)
            lens = tuple(d.tolist()) if np.any(d) else ()
            size = int(message.width), int(message.height)
            source = f"{self.path}: {connection.topic} holds a camera that cannot be used"
            if lens and message.distortion_model not in _LENSES:
                raise SourceError(f"{source}: {message.distortion_model}, expected {_LENSES[0]}: {UNDISTORT}")
            try:
                if min(size) < 1:
                    raise DatasetError(f"{source}: it has {size[0]}x{size[1]} pixels")
                check_matrix(source, k.reshape(3, 3))
                return camera_of(source, k[[0, 4, 2, 5]].tolist(), size, lens)
            except DatasetError as exc:
                raise SourceError(str(exc)) from exc
        return None


def _decode(message: Any, kind: str) -> npt.NDArray[np.uint8]:
    if kind == _COMPRESSED:
        return decode(bytes(message.data), f"{message.format} data")
    if message.encoding not in _ENCODINGS:
        raise ValueError(f"encoding {message.encoding} is none of {', '.join(_ENCODINGS)}")
    channels, conversion = _ENCODINGS[message.encoding]
    data = np.asarray(message.data, dtype=np.uint8)
    if data.size != message.height * message.step or message.step < message.width * channels:
        raise ValueError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = data.reshape(message.height, message.step)[:, : message.width * channels]
    image: npt.NDArray[np.uint8] = np.ascontiguousarray(rows.reshape(message.height, message.width, channels))
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), dtype=np.uint8)


def _reader(path: Path) -> Any:
    """An open reader, to be used as a context."""
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ModuleNotFoundError as exc:
        raise SourceError(f"{path}: ROS recordings need rosbags: pip install 'conformodal[ros]'") from exc
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as exc:  # as above
        raise SourceError(f"{path}: cannot be opened as a ROS recording: {exc}") from exc
    return _Opened(reader)


class _Opened:
    """A reader that is open already, closed at the end of a ``with``."""

    def __init__(self, reader: Any) -> None:
        self.reader = reader

    def __enter__(self) -> Any:
        return self.reader

    def __exit__(self, *_: object) -> None:
        self.reader.close()
