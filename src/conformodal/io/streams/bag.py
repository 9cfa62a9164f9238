"""ROS 1 bags, ROS 2 bags and MCAP files, through rosbags (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import Size
from conformodal.io.lenses import AnyCamera, Fisheye, seen_by
from conformodal.io.reading import Note

from .frames import Frame, SourceError, check_size
from .ros_messages import (
    COMPRESSED,
    INFO,
    RAW,
    camera_of_info,
    check_encoding,
    image_of,
    is_calibrated,
    is_swapped,
    key_of_info,
    stamp_s,
    white_of,
)

SUFFIXES = (".bag", ".mcap", ".db3", ".bag.active")
# What repairs recordings that cannot be opened, as those that were never closed.
_REPAIRS = {
    ".mcap": "; if it was never closed, repair it with 'mcap recover IN.mcap -o OUT.mcap'",
    ".bag": "; if it was never closed, repair it with 'rosbag reindex'",
    ".active": "; it was never closed: call it .bag, and repair it with 'rosbag reindex'",
}
_ZSTD = b"\x28\xb5\x2f\xfd"
_LOOKED_AT, _SET_BACK_S = 12, 1.0  # messages; a clock that goes back by more was set
_SET_ON_S, _LONGEST_PAUSE_S = 60.0, 3600.0  # so was one that goes on by more than was waited, or than anybody waits


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS recording: a bag file, or a folder with ``metadata.yaml``."""
    return path.name.lower().endswith(SUFFIXES) or (path.is_dir() and (path / "metadata.yaml").is_file())


class _Message(NamedTuple):
    """An image as it was sent; `info` is the CameraInfo where that changes."""

    content: Any
    kind: str
    stamp_s: float
    received_s: float
    info: Any


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
        Intrinsics; by default those of the first ``CameraInfo`` beside the images, to whose camera images of a fisheye
        lens, and of a later ``CameraInfo``, are brought. Another one replaces it where `first_lens` is known.
    received
        Whether times are those at which messages were received: the first headers have no stamps, or the same. Else
        the headers'.
    infos
        Topics of the ``CameraInfo`` that is followed; none where `camera` is given.
    first_lens
        What the first of these says.
    notes
        Which camera and which times are used, and what is unlikely.

    Raises
    ------
    SourceError
        If the recording is missing, damaged or without images that can be decoded.
    MissingPackageError
        If rosbags is not installed.
    """

    path: Path
    topic: str | None = None
    camera: PinholeCamera | None = None
    received: bool = False
    infos: tuple[str, ...] = ()
    first_lens: AnyCamera | None = None
    notes: tuple[Note, ...] = ()
    live = False

    def __post_init__(self) -> None:
        if not self.path.exists():
            raise SourceError(f"{self.path}: no such recording")
        notes: list[Note] = []
        with bag_reader(self.path) as reader:
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
            check_size(f"{self.path}: {chosen}", None if self.first_lens else size, self.camera)
            if self.camera is None and (lens := self._info(reader, size, notes)) is not None:
                object.__setattr__(self, "camera", lens.pinhole if isinstance(lens, Fisheye) else lens)
                object.__setattr__(self, "first_lens", lens)
        object.__setattr__(self, "notes", tuple(dict.fromkeys((*notes, *self.notes))))  # replace() keeps earlier ones

    @property
    def name(self) -> str:
        """The file's, and the topic."""
        return f"{self.path.name} {self.topic}"

    @property
    def n_frames(self) -> int:
        """Messages of the topic."""
        with bag_reader(self.path) as reader:
            return sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    def __iter__(self) -> Iterator[Frame]:
        """Decode message after message; one that cannot be decoded, or whose time is astray, comes without an image.

        A clock that is set back, for two messages or more, begins a new recording, whose times follow those before.
        """
        white, recording, shift_s = 0, 0, 0.0
        before: _Message | None = None  # the last message in order
        last_s: float | None = None  # its time
        back: float | None = None  # header stamp of the message before, if it was far back
        lens, info = self.first_lens, None  # and a CameraInfo that no image could be used with yet
        for number, (this, after) in enumerate(_with_next(self._messages())):
            name = f"{self.path.stem}-{number:06d}"
            place = f"{self.path}, message {number} of {self.topic}"
            info = this.info if this.info is not None else info
            astray = _astray(before, this, after)
            if astray is not None:
                problem = f"{place}: its stamp, {this.stamp_s:.3f} s, is far from those of its neighbours"
                yield Frame(name, astray + shift_s, None, problem, recording)
                continue
            time_s = this.stamp_s + shift_s
            if before is not None and last_s is not None and time_s < last_s - _SET_BACK_S:
                if back is not None and this.stamp_s > back:
                    recording += 1
                    shift_s = last_s + max(this.received_s - before.received_s, 1e-3) - this.stamp_s
                    time_s = this.stamp_s + shift_s
                back = this.stamp_s
            if last_s is None or time_s > last_s:
                before, last_s, back = this, time_s, None
            image, problem = None, ""
            try:
                white = max(white, white_of(this.content))
                image = image_of(this.content, this.kind, white)
                if info is not None:
                    size = image.shape[1], image.shape[0]
                    lens, info = camera_of_info(info, self.infos[0], str(self.topic), size), None
                if self.camera is not None and lens is not None:
                    image = seen_by(image, lens, self.camera)
            except ValueError as exc:
                image, problem = None, f"{place}: {exc}"
            yield Frame(name, time_s, image, problem, recording)

    def _messages(self) -> Iterator[_Message]:
        """The images as they were sent, and what says that their camera is another."""
        done, known, info = 0, "", None  # what the last CameraInfo says, and the message until it is taken
        with bag_reader(self.path) as reader:
            wanted = [c for c in reader.connections if c.topic == self.topic or c.topic in self.infos]
            messages = iter(reader.messages(connections=wanted))
            while True:
                try:
                    item = next(messages, None)
                    if item is None:
                        return
                    message, received_s = reader.deserialize(item[2], item[0].msgtype), item[1] / 1e9
                    if item[0].msgtype == INFO:
                        if (known or is_calibrated(message)) and (key := key_of_info(message)) != known:
                            known, info = key, message
                        continue
                    stamp = received_s if self.received else stamp_s(message)
                except Exception as exc:  # damaged bytes lead a decoder to any error
                    raise SourceError(f"{self.path}: breaks off after {done} images: {exc}") from exc
                yield _Message(message, item[0].msgtype, stamp, received_s, info)
                done, info = done + 1, None

    def _look_at_first(self, reader: Any, connections: list[Any], notes: list[Note]) -> Size | None:
        """Refuse an encoding that cannot be decoded; choose the times. The size of the images, if it is known."""
        place, stamps, size = f"{self.path}: {self.topic}", list[float](), None
        fault, white = "", 0
        for connection, _, raw in islice(reader.messages(connections=connections), _LOOKED_AT):
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except Exception as exc:  # it is told where the frames are read
                if bytes(raw[:4]) == _ZSTD:
                    raise SourceError(
                        f"{place}: its messages are compressed, as only metadata.yaml says; name the folder of both"
                    ) from exc
                break
            if connection.msgtype == RAW:
                check_encoding(message.encoding, place)
            elif is_swapped(message.format):
                notes.append(
                    Note("red and blue are swapped", f"{place}: as image_transport does for {message.format!r}")
                )
            stamps.append(stamp_s(message))
            try:
                white = max(white, white_of(message))
                height, width = image_of(message, connection.msgtype).shape[:2]
                size = size or (width, height)
            except ValueError as exc:
                fault = fault or str(exc)
        if fault and size is None and connections[0].msgtype == COMPRESSED:
            raise SourceError(f"{place}: {fault}")
        if len(stamps) < 2 * stamps.count(0) or (len(stamps) > 1 and len(set(stamps)) == 1):
            object.__setattr__(self, "received", True)
            notes.append(Note("no header stamps", f"{place}: times are those of reception"))
        if white > 255:
            notes.append(Note("16-bit images", f"{place}: {white} of 65535 is shown as white"))
        return size

    def _info(self, reader: Any, size: Size | None, notes: list[Note]) -> AnyCamera | None:
        """The camera of the first calibrated CameraInfo in the images' name space."""
        space = str(self.topic).removesuffix("/compressed").rpartition("/")[0]
        infos = [c for c in reader.connections if c.msgtype == INFO and c.topic.rpartition("/")[0] == space]
        named = sorted({c.topic for c in infos}, key=partial(_unlike, str(self.topic)))[:1]
        infos = [c for c in infos if c.topic in named]  # of several cameras in one name space, the most alike by name
        object.__setattr__(self, "infos", tuple(named))
        zeros = ""
        for connection, _, raw in reader.messages(connections=infos) if infos else ():
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except Exception as exc:  # as above
                raise SourceError(f"{self.path}: {connection.topic} cannot be decoded: {exc}") from exc
            if is_calibrated(message):
                return camera_of_info(message, f"{self.path}: {connection.topic}", str(self.topic), size, notes)
            zeros = f"; {connection.topic} has zeros"
        object.__setattr__(self, "infos", ())
        others = ", ".join(sorted({c.topic for c in reader.connections if c.msgtype == INFO} - {*named})) or "none"
        where = f"{self.path}: {self.topic}: its camera is not known{zeros}; in other name spaces: {others}"
        notes.append(Note("no CameraInfo", where))
        return None


def _with_next(messages: Iterator[_Message]) -> Iterator[tuple[_Message, _Message | None]]:
    """Each message with the one after it; an error comes after the messages before it."""
    held: _Message | None = None
    try:
        for message in messages:
            if held is not None:
                yield held, message
            held = message
    except SourceError:
        if held is not None:
            yield held, None
        raise
    if held is not None:
        yield held, None


def _astray(before: _Message | None, this: _Message, after: _Message | None) -> float | None:
    """A time, seconds, for a message whose stamp is far from those of its neighbours; None where it is not.

    It is ahead of the next, which follows the one before; or the first or last, and a clock was set beside it.
    """
    if after is None:
        return before.stamp_s + 1e-3 if before is not None and _set_on(before, this) else None
    if before is None:
        ahead = this.stamp_s > after.stamp_s + _SET_BACK_S
        return after.stamp_s - 1e-3 if ahead or _set_on(this, after) else None
    ahead = this.stamp_s > after.stamp_s + _SET_BACK_S and after.stamp_s > before.stamp_s
    return (before.stamp_s + after.stamp_s) / 2 if ahead else None


def _set_on(first: _Message, second: _Message) -> bool:
    """Whether the clock was set between two messages, to a later time."""
    waited = min(max(second.received_s - first.received_s, 0.0), _LONGEST_PAUSE_S)
    return second.stamp_s - first.stamp_s > waited + _SET_ON_S


@contextmanager
def bag_reader(path: Path) -> Iterator[Any]:
    """An open reader."""
    with require_extra("ros", f"{path}: a ROS recording"):
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as exc:  # as above
        hint = _REPAIRS.get(path.suffix, "") if path.stat().st_size else ""
        if path.is_file() and path.suffix != path.suffix.lower():  # not a folder, such as run.A
            hint = f"; rename it to {path.stem}{path.suffix.lower()}"
        raise SourceError(f"{path}: cannot be opened as a ROS recording: {exc}{hint}") from exc
    with closing(reader):
        yield reader


def _unlike(topic: str, info: str) -> tuple[int, bool, str]:
    """A key that sorts the topics of CameraInfo by how little their names have in common with that of the images."""
    alike = next((k for k, (one, other) in enumerate(zip(topic, info, strict=False)) if one != other), len(info))
    return -alike, not info.endswith("camera_info"), info
