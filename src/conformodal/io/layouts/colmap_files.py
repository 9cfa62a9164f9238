"""The files of a COLMAP model: text is read here, binary by pycolmap (extra ``colmap``)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.io.cameras import Size
from conformodal.io.errors import DatasetError
from conformodal.io.reading import number, read_lines, whole_number

_POINTS = re.compile(r"[0-9eE+\-. \tnaifNAIF]*")  # numbers alone; an image's name has a letter that no number has
_IMAGE = "'id qw qx qy qz tx ty tz camera name'"


@dataclass(frozen=True)
class ColmapCamera:
    """A camera; `where` is its place in the model."""

    where: str
    model: str
    size: Size
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """Pose, world to camera, of an image."""

    quat_wxyz: list[float]
    shift_xyz: list[float]
    camera: ColmapCamera


@dataclass(frozen=True)
class ColmapModel:
    """Images by name, and the file that they are from."""

    path: Path
    images: dict[str, ColmapImage]


def model_suffixes(place: Path) -> list[str]:
    """``bin`` and ``txt``, of a folder that holds a model; COLMAP reads the first where there are both."""
    return [s for s in ("bin", "txt") if all((place / f"{n}.{s}").is_file() for n in ("images", "cameras"))]


def read_model(place: Path) -> ColmapModel:
    """Read the model of a folder."""
    if model_suffixes(place)[0] == "bin":
        return _binary_model(place)
    path = place / "images.txt"
    return _model(path, _image_rows(path), _cameras(place / "cameras.txt"))


def _model(path: Path, rows: list[tuple[str, list[float], int]], cameras: dict[int, ColmapCamera]) -> ColmapModel:
    """A model from name, quaternion with translation, and camera of every image."""
    images: dict[str, ColmapImage] = {}
    for name, pose, camera in rows:
        if name in images:
            raise DatasetError(f"{path}: names {name[:80]!r} a second time, expected one pose per image")
        if camera not in cameras:
            raise DatasetError(f"{path}: uses camera {camera}, expected one of {sorted(cameras)}")
        images[name] = ColmapImage(pose[:4], pose[4:], cameras[camera])
    if not images:
        raise DatasetError(f"{path}: holds no image")
    return ColmapModel(path, images)


def _image_rows(path: Path) -> list[tuple[str, list[float], int]]:
    """Images of a text: a line of points follows every image, which may be empty, or none does."""
    lines = [(at, line) for at, line in enumerate(read_lines(path), start=1) if not line.startswith("#")]
    while lines and not lines[-1][1].strip():
        lines.pop()
    with_points = any(_POINTS.fullmatch(line) for _, line in lines)
    rows = []
    for k, (at, line) in enumerate(lines):
        if with_points and k % 2:
            if not _POINTS.fullmatch(line) or len(line.split()) % 3:
                raise DatasetError(f"{path}, line {at}: expected a line of points after every image, got {line[:80]!r}")
            continue
        fields = line.split(maxsplit=9)
        try:
            whole_number(fields[0])
            rows.append((fields[9].strip(), [number(v) for v in fields[1:8]], whole_number(fields[8])))
        except (ValueError, IndexError):
            raise DatasetError(f"{path}, line {at}: expected {_IMAGE}, got {line[:80]!r}") from None
    return rows


def _cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for at, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{path}, line {at}"
        try:
            key, model, width, height, *values = line.split()
            camera = ColmapCamera(where, model, (whole_number(width), whole_number(height)), tuple(map(number, values)))
            twice = cameras.setdefault(whole_number(key), camera) is not camera
        except ValueError as exc:
            raise DatasetError(f"{where}: expected 'id model width height parameters', got {line[:80]!r}") from exc
        if twice:
            raise DatasetError(f"{where}: gives camera {key} a second time, expected each once")
    return cameras


def _binary_model(place: Path) -> ColmapModel:
    images_path, cameras_path = place / "images.bin", place / "cameras.bin"
    with require_extra("colmap", f"{images_path}: a binary COLMAP model"):
        import pycolmap  # noqa: PLC0415 - an extra
    with TemporaryDirectory() as scratch:  # without the points, which are many and not needed
        for path in (images_path, cameras_path):
            (Path(scratch) / path.name).symlink_to(path.resolve())
        (Path(scratch) / "points3D.bin").write_bytes(bytes(8))
        try:
            model: Any = pycolmap.Reconstruction(scratch)
        except Exception as exc:  # damaged bytes lead it to any error
            raise DatasetError(f"{place}: cannot be read as a binary COLMAP model: {exc}") from exc
    # pycolmap reads on past the end of a file, and leaves what follows the last record
    image_bytes = sum(73 + len(image.name.encode()) + 24 * image.num_points2D() for image in model.images.values())
    camera_bytes = sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    for path, n_bytes in ((images_path, 8 + image_bytes), (cameras_path, 8 + camera_bytes)):
        if path.stat().st_size != n_bytes:
            raise DatasetError(f"{path}: has {path.stat().st_size} bytes, expected {n_bytes}; copy it again")
    cameras = {
        key: ColmapCamera(f"{cameras_path}, camera {key}", c.model.name, (c.width, c.height), tuple(c.params.tolist()))
        for key, c in model.cameras.items()
    }
    rows = []
    for image in model.images.values():
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat.tolist()
        rows.append((image.name, [w, x, y, z, *pose.translation.tolist()], int(image.camera_id)))
    return _model(images_path, rows, cameras)
