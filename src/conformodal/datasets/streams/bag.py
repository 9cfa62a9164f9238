"""ROS 1 bags, ROS 2 bags and MCAP files, through rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from conformodal.datasets.cameras import Size
from conformodal.datasets.reading import Note
from conformodal.poses import PinholeCamera

from .frames import Frame, SourceError
from .ros_messages import COMPRESSED, INFO, RAW, camera_of_info, check_encoding, image_of, stamp_s, white_of

SUFFIXES = (".bag", ".mcap", ".db3")
# What rosbags says of recordings that were never closed, and what repairs them.
_REPAIRS = {
    "File end magic": "; it was never closed: repair it with 'mcap recover IN.mcap -o OUT.mcap'",
    "not indexed": "; it was never closed: repair it with 'rosbag reindex'",
}


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
        Of the images; may be left out if there is only one.
    camera
        Intrinsics; by default those of the first ``CameraInfo`` beside the images.
    received
        Whether times are those at which messages were received: the first header has no stamp. Else the headers'.
    notes
        Which camera and which times are used, and what is unlikely.

    Raises
    ------
    SourceError
        If rosbags is not installed, or the recording is missing, damaged or without images that can be decoded.
    """

    path: Path
    topic: str | None = None
    camera: PinholeCamera | None = None
    received: bool = False
    notes: tuple[Note, ...] = ()
    live = False

    def __post_init__(self) -> None:
        if not self.path.exists():
            raise SourceError(f"{self.path}: no such recording")
        notes: list[Note] = []
        with _reader(self.path) as reader:
            images = [c for c in reader.connections if c.msgtype in (RAW, COMPRESSED)]
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
            size = self._look_at_first(reader, [c for c in images if c.topic == chosen], notes)
            if self.camera is None:
                object.__setattr__(self, "camera", self._info(reader, size, notes))
        object.__setattr__(self, "notes", tuple(notes))

    @property
    def name(self) -> str:
        """The file's, and the topic."""
        return f"{self.path.name} {self.topic}"

    @property
    def n_frames(self) -> int:
        """Messages of the topic."""
        with _reader(self.path) as reader:
            return sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    def __iter__(self) -> Iterator[Frame]:
        """Decode message after message; one that cannot be decoded comes without an image."""
        done, white = 0, 0
        with _reader(self.path) as reader:
            wanted = [c for c in reader.connections if c.topic == self.topic]
            messages = iter(reader.messages(connections=wanted))
            while True:
                try:
                    item = next(messages, None)
                    if item is None:
                        return
                    message = reader.deserialize(item[2], item[0].msgtype)
                    time_s = item[1] / 1e9 if self.received else stamp_s(message)
                except Exception as exc:  # damaged bytes lead a decoder to any error
                    raise SourceError(f"{self.path}: breaks off after {done} images: {exc}") from exc
                image, problem = None, ""
                try:
                    white = max(white, white_of(message))
                    image = image_of(message, item[0].msgtype, white)
                except ValueError as exc:
                    problem = f"{self.path}, message {done} of {self.topic}: {exc}"
                yield Frame(f"{self.path.stem}-{done:06d}", time_s, image, problem)
                done += 1

    def _look_at_first(self, reader: Any, connections: list[Any], notes: list[Note]) -> Size | None:
        """Refuse an encoding that cannot be decoded; choose the times. The size of the images, if it is said."""
        for connection, _, raw in reader.messages(connections=connections):
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except Exception:  # it is told where the frames are read
                return None
            if connection.msgtype == RAW:
                check_encoding(message.encoding, f"{self.path}: {self.topic}")
            if stamp_s(message) == 0:
                object.__setattr__(self, "received", True)
                notes.append(Note("no header stamps", f"{self.path}: {self.topic}: times are those of reception"))
            if (white := white_of(message)) > 255:
                notes.append(Note("16-bit images", f"{self.path}: {self.topic}: {white} of 65535 is shown as white"))
            return (int(message.width), int(message.height)) if connection.msgtype == RAW else None
        return None

    def _info(self, reader: Any, size: Size | None, notes: list[Note]) -> PinholeCamera | None:
        """The camera of the first CameraInfo in the images' name space."""
        space = str(self.topic).removesuffix("/compressed").rpartition("/")[0]
        infos = [c for c in reader.connections if c.msgtype == INFO and c.topic.rpartition("/")[0] == space]
        for connection, _, raw in reader.messages(connections=infos) if infos else ():
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except Exception as exc:  # as above
                raise SourceError(f"{self.path}: {connection.topic} cannot be decoded: {exc}") from exc
            return camera_of_info(message, f"{self.path}: {connection.topic}", str(self.topic), size, notes)
        return None


@contextmanager
def _reader(path: Path) -> Iterator[Any]:
    """An open reader."""
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ModuleNotFoundError as exc:
        raise SourceError(f"{path}: ROS recordings need rosbags: pip install 'conformodal[ros]'") from exc
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as exc:  # as above
        hint = next((hint for sign, hint in _REPAIRS.items() if sign in str(exc)), "")
        raise SourceError(f"{path}: cannot be opened as a ROS recording: {exc}{hint}") from exc
    with closing(reader):
        yield reader
