"""COLMAP models (Schoenberger and Frahm 2016): ``cameras.txt`` and ``images.txt``, or the same in ``.bin``.

COLMAP stores world-to-camera poses, quaternion ``wxyz`` first, in cameras with x right and y down, as here. Text is
read here, binary by pycolmap (extra ``colmap``).
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera
from conformodal.geometry.poses import matrices_of, table_of
from conformodal.io.cameras import Size, camera_of
from conformodal.io.decoding import common_size
from conformodal.io.diagnosis.cameras import UNDISTORT
from conformodal.io.diagnosis.columns import length_doubt
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import DOUBTFUL, FrameTable
from conformodal.io.pose_files import PoseRows, pose_faults
from conformodal.io.reading import (
    Note,
    by_name,
    file_named,
    image_files,
    number,
    parse_lines,
    read_lines,
    times_by_folder,
    whole_number,
)

# Parameters of the camera models that are read, by COLMAP's names.
_LENSES = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
_POINTS = re.compile(r"[0-9eE+\-. \tnaifNAIF]*")  # numbers alone; an image's name has a letter that no number has


class _Camera(NamedTuple):
    where: str  # its place in the model
    model: str
    size: Size
    parameters: tuple[float, ...]


class _Image(NamedTuple):
    name: str
    quat_wxyz: list[float]  # from world to camera
    shift_xyz: list[float]
    camera: int  # its number


class _Model(NamedTuple):
    path: Path  # of the images
    images: list[_Image]
    cameras: dict[int, _Camera]


def model_folders(folder: Path) -> list[Path]:
    """Where in a folder models lie: COLMAP writes one for every part that it could not join, ``sparse/1`` and so on."""
    places = [folder, folder / "sparse", *sorted((folder / "sparse").glob("*")), folder / "text"]
    return [place for place in places if any(_holds(place, suffix) for suffix in ("bin", "txt"))]


def _holds(place: Path, suffix: str) -> bool:
    return all((place / f"{name}.{suffix}").is_file() for name in ("images", "cameras"))


def read_colmap(folder: Path) -> FrameTable:
    """Read the images of a model, in the natural order of their names.

    The folder has ``images`` (or the images themselves) and the model in it, in ``sparse``, ``sparse/0`` or ``text``;
    or it is the model's own, with ``images`` above it. Of several models the one of most images is read. Images in
    ``images`` that the model does not name are frames without a pose; folders in it are recordings. Times are those of
    ``times.txt`` (seconds, one per line), or else even (``frame-rate.txt`` in Hz, or 30). The scale is the model's
    own, unless ``metres-per-unit.txt`` gives one. Images of other cameras than most have are brought to that, once.
    """
    notes: list[Note] = []
    models = [_binary_model(place) if _holds(place, "bin") else _text_model(place) for place in model_folders(folder)]
    if not models:
        raise DatasetError(f"{folder}: holds no COLMAP model; expected cameras.txt and images.txt, or the same in .bin")
    model = max(models, key=lambda model: len(model.images))
    if others := [f"{m.path.parent} ({len(m.images)} images)" for m in models if m is not model]:
        where = f"{model.path.parent} ({len(model.images)} images) is read, not {', '.join(others)}"
        notes.append(Note("other models are not read", where))
    of_name = {image.name: image for image in model.images}
    if not model.images or len(of_name) < len(model.images) or {i.camera for i in model.images} - set(model.cameras):
        raise DatasetError(f"{model.path}: holds no image, or one twice, or one whose camera is not in the model")
    base = _image_folder(folder, model)
    paths = {name: file_named(base, name) for name in of_name}
    if base != folder:  # images that COLMAP has no pose for
        places = {path.parent for path in paths.values() if path.parent.is_relative_to(base) and path.parent.is_dir()}
        beside = [path for place in places for path in image_files(place) if path not in set(paths.values())]
        paths |= {str(path.relative_to(base)): path for path in beside}
    names = by_name(paths, str)
    usual = Counter(image.camera for image in model.images).most_common(1)[0][0]
    keys = [of_name[name].camera if name in of_name else usual for name in names]
    images = [paths[name] for name in names]
    by_camera = {key: [image for image, other in zip(images, keys, strict=True) if other == key] for key in set(keys)}
    lenses = {key: _lens(model.cameras[key], common_size(some), notes) for key, some in sorted(by_camera.items())}
    times, recording = times_by_folder(folder, images)
    cameras = [lenses[key] for key in keys]
    table = FrameTable(folder.name, images, times, cameras, recording=recording, notes=notes)
    table.root, table.source, table.as_stored = folder if base.is_relative_to(folder) else base, model.path, True
    missing = _Image("", [np.nan] * 4, [np.nan] * 3, usual)
    placed = [of_name.get(name, missing) for name in names]
    rows = np.array([[*image.shift_xyz, *image.quat_wxyz] for image in placed])
    if doubt := length_doubt(model.path, rows, 3):
        notes.append(Note(DOUBTFUL, doubt))
    to_camera = PoseRows(model.path, rows)
    unnamed = {i: "the model does not name the image" for i, image in enumerate(placed) if image is missing}
    to_camera.drop(unnamed | pose_faults(rows[:, :3], rows[:, 3:]))
    poses = matrices_of(to_camera.rows)
    sound = np.isfinite(poses).all(axis=(1, 2))
    poses[sound] = np.linalg.inv(poses[sound])
    table.poses, table.why = table_of(poses), to_camera.faults
    table.scale_by(folder)
    return table


def _image_folder(folder: Path, model: _Model) -> Path:
    """The folder that a model's names start from: ``images`` in or above the given one, or that one itself."""
    for base in (*(above / "images" for above in (folder, *folder.parents[:3])), folder):
        if any(file_named(base, image.name).is_file() for image in model.images):
            return base
    raise DatasetError(f"{model.path}: names {model.images[0].name}, expected it in {folder / 'images'}; link it there")


def _lens(camera: _Camera, size: Size, notes: list[Note]) -> PinholeCamera:
    names = _LENSES.get(camera.model, "").split()
    if not names or len(camera.parameters) != len(names):
        model = f"{camera.model[:40]} of {len(camera.parameters)} parameters"
        raise DatasetError(f"{camera.where}: camera model {model} is none of {', '.join(_LENSES)}: {UNDISTORT}")
    value = dict(zip(names, camera.parameters, strict=True))
    # COLMAP's first pixel has its centre at (0.5, 0.5), OpenCV's at (0, 0)
    centre = value["cx"] - 0.5, value["cy"] - 0.5
    pixels = value.get("f", value.get("fx", 0.0)), value.get("f", value.get("fy", 0.0)), *centre
    distortion = tuple(value.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    distortion = distortion if "k3" in value else distortion[:4]
    return camera_of(camera.where, pixels, size, distortion, stated=camera.size, notes=notes)


def _text_model(place: Path) -> _Model:
    """A model as text: after the line of an image comes one of its points, which may be empty."""
    path, images = place / "images.txt", list[_Image]()
    lines = [(at, line) for at, line in enumerate(read_lines(path), start=1) if not line.startswith("#")]
    for k, (at, line) in enumerate(lines):
        fields = line.split(maxsplit=9)
        try:
            if k % 2 == 0:
                pose = [number(v) for v in fields[1:8]]
                images.append(_Image(fields[9].strip(), pose[:4], pose[4:], whole_number(fields[8])))
            elif not _POINTS.fullmatch(line):
                raise ValueError("not points")
        except (ValueError, IndexError):
            expected = "'id qw qx qy qz tx ty tz camera name'" if k % 2 == 0 else "a line of points after every image"
            raise DatasetError(f"{path}, line {at}: expected {expected}, got {line[:80]!r}") from None

    def camera(line: str) -> tuple[int, _Camera]:
        key, model, width, height, *values = line.split()
        size = whole_number(width), whole_number(height)
        return whole_number(key), _Camera(f"{path}, camera {key}", model, size, tuple(map(number, values)))

    path = place / "cameras.txt"
    cameras = parse_lines(path, camera, "'id model width height parameters'")
    if len(dict(cameras)) < len(cameras):
        raise DatasetError(f"{path}: gives a camera twice, expected each once")
    return _Model(place / "images.txt", images, dict(cameras))


def _binary_model(place: Path) -> _Model:
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
        key: _Camera(f"{cameras_path}, camera {key}", c.model.name, (c.width, c.height), tuple(c.params.tolist()))
        for key, c in model.cameras.items()
    }
    images = []
    for image in model.images.values():
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat.tolist()
        images.append(_Image(image.name, [w, x, y, z], pose.translation.tolist(), int(image.camera_id)))
    return _Model(images_path, images, cameras)
