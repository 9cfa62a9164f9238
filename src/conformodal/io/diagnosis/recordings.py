"""Why a file cannot be opened as a ROS recording: of which kind it is, and what messages an MCAP file has."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from conformodal.core.files import foreign_kind

_MCAP, _SQLITE, _BAG = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V"
_MAGIC = {".mcap": _MCAP, ".db3": _SQLITE, ".bag": _BAG, ".active": _BAG}
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _CHUNK = 0x01, 0x02, 0x03, 0x04, 0x06
_ROS_ENCODINGS = {"ros1", "cdr"}
_MAX_RECORD, _MAX_SHOWN = 1 << 20, 4
_REPAIR = "if it was never closed, repair it with {}"
_HOW = {
    ".mcap": "'mcap recover IN -o OUT'",
    ".bag": "'rosbag reindex', under the name .bag",
    ".active": "'rosbag reindex', under the name .bag",
}


class McapContent(NamedTuple):
    """What an MCAP file says of itself."""

    profile: str
    topics: dict[str, tuple[str, str]]  # schema and encoding of the messages by topic
    closed: bool


def describe_unopened(path: Path) -> str:
    """What to do about a recording that cannot be opened, after the reader's own words."""
    kind = path.suffix.lower()
    if not path.is_file():
        return "; is metadata.yaml complete, and are its files there? 'ros2 bag reindex' writes it anew"
    with suppress(OSError):
        with path.open("rb") as file:
            start = file.read(512)
        if foreign := foreign_kind(start):
            return f"; it {foreign}"
        magic = _MAGIC.get(kind)
        if magic is not None and not start.startswith(magic):
            return f"; it begins with {start[:8]!r}, expected {magic!r}: it is not such a file, or was cut off"
    if kind == ".mcap":
        return _of_mcap(read_mcap(path))
    return f"; {_REPAIR.format(_HOW[kind])}" if kind in _HOW else ""


def _of_mcap(content: McapContent) -> str:
    if not content.closed:
        return f"; {_REPAIR.format(_HOW['.mcap'])}"
    others = {t: kind for t, kind in content.topics.items() if kind[1] not in _ROS_ENCODINGS}
    if others and len(others) == len(content.topics):
        shown = [f"{schema} as {encoding} on {topic}" for topic, (schema, encoding) in sorted(others.items())]
        more = f" and {len(shown) - _MAX_SHOWN} more" if len(shown) > _MAX_SHOWN else ""
        return (
            f"; its messages are not of ROS: {', '.join(shown[:_MAX_SHOWN])}{more}; record them as ROS messages "
            "(sensor_msgs/msg/CompressedImage, in cdr), or write the images and their times as a data set"
        )
    if content.profile in ("ros1", "ros2"):
        return ""
    profile = f"its profile is {content.profile!r}, expected ros1 or ros2"
    return f"; {profile}; 'ros2 bag convert' writes it anew, if its messages are of ROS"


def read_mcap(path: Path) -> McapContent:
    """Profile and topics of an MCAP file, from its summary or else from its records, and whether it was closed."""
    size = path.stat().st_size
    profile, schemas, topics = "", dict[int, str](), dict[str, tuple[str, str]]()
    closed, start = False, 0
    with path.open("rb") as file, suppress(struct.error, ValueError, OverflowError, OSError):
        file.seek(max(size - len(_MCAP) - 29, 0))
        end = file.read()
        closed = end.endswith(_MCAP)
        if closed and end[:1] == bytes([_FOOTER]):
            start = struct.unpack_from("<Q", end, 9)[0]
        file.seek(len(_MCAP))
        for code, content in _records(file, size):
            if code == _HEADER:
                profile = _text(content, 0)[0]
                if start:
                    file.seek(start)
                    start = 0  # once, wherever it leads
            elif code == _SCHEMA:
                schemas[struct.unpack_from("<H", content)[0]] = _text(content, 2)[0]
            elif code == _CHANNEL:
                _, schema = struct.unpack_from("<HH", content)
                topic, at = _text(content, 4)
                topics[topic] = (schemas.get(schema, "no schema"), _text(content, at)[0])
    return McapContent(profile, topics, closed)


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Records of a file from where it is on, and of chunks that are not compressed; large ones are passed over."""
    while len(head := file.read(9)) == 9:
        code, length = struct.unpack("<BQ", head)
        here = file.tell()
        if code == _CHUNK:
            inside = file.read(min(length, 64))
            compression, at = _text(inside, 28)
            if not compression:
                file.seek(here + at + 8)  # its records follow
                continue
            file.seek(here + length)
        elif length > _MAX_RECORD or code not in (_HEADER, _SCHEMA, _CHANNEL):
            file.seek(min(here + length, size))
        else:
            yield code, file.read(length)


def _text(content: bytes, at: int) -> tuple[str, int]:
    """A string of a record, and where it ends."""
    length = struct.unpack_from("<I", content, at)[0]
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length
