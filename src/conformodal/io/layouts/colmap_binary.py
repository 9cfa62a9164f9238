"""COLMAP binary models: ``cameras.bin`` and ``images.bin``, little-endian, as COLMAP's documentation describes them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from conformodal.io.errors import DatasetError

# By number in the file: name and how many parameters.
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
N_PARAMETERS = dict(_MODELS)
_MOST_MODELS = 64
_POINT_BYTES = 24  # x, y and the number of a point
_LONGEST_NAME = 4096


class _Bytes:
    """A file that is read from front to back."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            self.content = path.read_bytes()
        except OSError as exc:
            raise DatasetError(f"{path}: cannot be read: {exc.strerror}") from exc

    def take(self, form: str, skipped: int = 0) -> tuple[float, ...]:
        """The next numbers, of a form of :mod:`struct`, and pass over bytes behind them."""
        try:
            found = struct.unpack_from(f"<{form}", self.content, self.at)
        except struct.error:
            found = None
        self.at += struct.calcsize(f"<{form}") + skipped
        if found is None or self.at > len(self.content):
            raise self.damaged(f"ends after {len(self.content)} bytes, within a record")
        return found

    def name(self) -> str:
        """The next name, which a zero byte ends."""
        end = self.content.find(b"\0", self.at, self.at + _LONGEST_NAME)
        if end < 0:
            raise self.damaged("a name has no end")
        raw, self.at = self.content[self.at : end], end + 1
        return raw.decode("utf-8", errors="surrogateescape")

    def damaged(self, what: str) -> DatasetError:
        """The error of a file that is none of COLMAP's."""
        return DatasetError(f"{self.path}: is no binary model of COLMAP, byte {self.at}: {what}")

    def records(self, what: str) -> Iterator[int]:
        """Count the file's records while they are read, one or more and nothing after them."""
        n = int(self.take("Q")[0])
        yield from range(n)
        if self.at != len(self.content):
            raise self.damaged(f"{len(self.content) - self.at} bytes follow the last record")
        if not n:
            raise DatasetError(f"{self.path}: holds no {what}")


def binary_images(path: Path) -> dict[str, tuple[list[float], list[float], int]]:
    """Quaternion, translation and camera by image name."""
    file = _Bytes(path)
    found: dict[str, tuple[list[float], list[float], int]] = {}
    for _ in file.records("image"):
        _, *pose, camera = file.take("i7di")
        name = file.name()
        if name in found:
            raise DatasetError(f"{path}: names {name[:80]!r} a second time, expected one pose for an image")
        found[name] = (pose[:4], pose[4:], int(camera))
        (points,) = file.take("Q")
        file.take("", int(points) * _POINT_BYTES)
    return found


def binary_cameras(path: Path) -> dict[int, tuple[str, list[str]]]:
    """Place in the file and fields, as a text model has them, by camera."""
    file = _Bytes(path)
    found = {}
    for k in file.records("camera"):
        camera, model, width, height = (int(v) for v in file.take("iiQQ"))
        if camera in found:
            raise DatasetError(f"{path}: gives camera {camera} a second time, expected each once")
        if not 0 <= model < len(_MODELS):  # of a later COLMAP: nobody knows how long its record is
            if not 0 <= model < _MOST_MODELS:
                raise file.damaged(f"camera {camera} has the model {model}, expected 0 to {len(_MODELS) - 1}")
            found[camera] = (f"record {k + 1}", [str(camera), f"number {model}"])
            break
        name, n_parameters = _MODELS[model]
        values = map(repr, file.take(f"{n_parameters}d"))
        found[camera] = (f"record {k + 1}", [str(camera), name, str(width), str(height), *values])
    return found
