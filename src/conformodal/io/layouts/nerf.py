"""NeRF's ``transforms.json`` (Mildenhall et al. 2020; Mueller et al. 2022): one file with camera and poses.

Its cameras look along -z with y up, as in OpenGL; they are turned about x when they are read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.geometry import PinholeCamera
from conformodal.geometry.poses import table_of
from conformodal.io.cameras import Size, camera_of
from conformodal.io.decoding import common_size
from conformodal.io.diagnosis.cameras import UNDISTORT
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import matrix_faults
from conformodal.io.reading import MALFORMED, SUFFIXES, Note, by_name, file_named, read_lines, times_by_folder

FILES = ("transforms.json", "transforms_train.json")
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_LENS, _ANGLE = ("k1", "k2", "p1", "p2", "k3"), "camera_angle_x"
_WORDS = ("camera_model", "is_fisheye")
_CAMERA_KEYS = ("fl_x", "fl_y", _ANGLE, "cx", "cy", "w", "h", "k4", *_LENS, *_WORDS)
_AGREE = 0.02  # of focal length and field of view
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


def transforms_file(folder: Path) -> Path | None:
    """The file of frames in a folder: ``transforms.json``, or else that of the training frames."""
    return next((folder / name for name in FILES if (folder / name).is_file()), None)


def read_nerf(folder: Path) -> FrameTable:
    """Read the frames of ``transforms.json``, or else of ``transforms_train.json``, in the order of their file names.

    They share one camera. Times are those of ``times.txt`` (seconds, one per line), or else even (``frame-rate.txt``
    in Hz, or 30). World and scale are the file's own, unless ``metres-per-unit.txt`` gives one.
    """
    path = transforms_file(folder) or folder / FILES[0]
    notes: list[Note] = []
    try:
        content: Any = json.loads("\n".join(read_lines(path)))
        frames, names = content["frames"], [str(frame["file_path"]) for frame in content["frames"]]
        poses = np.array([_matrix(frame.get("transform_matrix")) for frame in frames]).reshape(-1, 4, 4)
        stated = [{k: frame.get(k, content.get(k)) for k in _CAMERA_KEYS} for frame in frames]
        camera = {k: v if k in _WORDS else _number(v) for k, v in stated[0].items() if v is not None}
    except (*MALFORMED, DatasetError) as exc:
        raise DatasetError(f"{path}: is not a NeRF file: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if any(other != stated[0] for other in stated):
        raise DatasetError(f"{path}: gives frames cameras of their own; {UNDISTORT}, the same for all")
    if other := next((key for key in content if "distort" in key and content[key]), None):
        raise DatasetError(f"{path}: has {other[:40]}, expected the lens as {', '.join(_LENS)}")
    order = by_name(range(len(names)), lambda i: names[i])
    names, poses = [names[i] for i in order], poses[order]
    images = [_image(folder, name) for name in names]
    if not any(map(os.path.isfile, images)):
        raise DatasetError(f"{path}: names {names[0]}, but there is no such image in {folder}")
    lens = _camera(path, camera, common_size(images), notes)
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    times, recording = times_by_folder(folder, images)
    # the product turns the columns
    rows = table_of(poses * np.diag(OPENGL_AXES))
    table = FrameTable(folder.name, images, times, lens, rows, recording, notes=notes)
    table.why = {i: f"{path}: transform_matrix {fault}" for i, fault in faults.items()}
    table.root, table.source, table.as_stored = folder, path, True
    table.scale_by(folder)
    return table


def _matrix(rows: Any) -> list[list[float]]:
    """Three or four rows of four numbers; NaN for a frame without a pose."""
    if rows is None:
        return [[np.nan] * 4] * 4
    if [len(row) for row in rows] not in ([4] * 4, [4] * 3):
        raise ValueError("transform_matrix must be a list of 4 lists of 4 numbers")
    return [[_number(v) for v in row] for row in (*rows, (0.0, 0.0, 0.0, 1.0))][:4]


def _number(value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError(f"{str(value)[:40]!r} is not a number")
    return float(value)


def _image(folder: Path, name: str) -> Path:
    """The file of a name, whose suffix may be left out."""
    named = [file_named(folder, f"{name}{suffix}") for suffix in ("", *SUFFIXES)]
    return next((path for path in named if os.path.lexists(path)), named[0])


def _camera(path: Path, values: dict[str, Any], size: Size, notes: list[Note]) -> PinholeCamera:
    model = values.get("camera_model", "OPENCV")
    if model not in _MODELS or values.get("is_fisheye") or values.get("k4"):
        given = f"camera_model {str(model)[:40]} with {', '.join(sorted(values))}"
        raise DatasetError(f"{path}: has {given}, expected one of {', '.join(_MODELS)}: {UNDISTORT}")
    if ("w" in values) != ("h" in values) or not 0 < values.get(_ANGLE, 1.0) < np.pi:
        raise DatasetError(f"{path}: expected both w and h or none, and {_ANGLE} in radians between 0 and 3.14")
    whole = (round(values["w"]), round(values["h"])) if "w" in values else size
    by_angle = whole[0] / np.tan(values[_ANGLE] / 2) / 2 if _ANGLE in values else None
    fx = values.get("fl_x", by_angle)
    if fx is None or abs((by_angle or fx) / fx - 1) > _AGREE:
        raise DatasetError(f"{path}: has fl_x {fx} and {_ANGLE} {values.get(_ANGLE)}, expected one or both alike")
    # the first pixel's centre is (0.5, 0.5), as in COLMAP; OpenCV's is (0, 0)
    pixels = fx, values.get("fl_y", fx), values.get("cx", whole[0] / 2) - 0.5, values.get("cy", whole[1] / 2) - 0.5
    lens = tuple(values.get(name, 0.0) for name in _LENS)
    where = f"{path}: fl_x, fl_y, cx, cy"
    return camera_of(where, pixels, size, lens if lens[4] else lens[:4], stated=whole, notes=notes)
