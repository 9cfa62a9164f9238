"""NeRF's ``transforms.json`` (Mildenhall et al. 2020; Mueller et al. 2022): one file with camera and poses.

Its cameras look along -z with y up, as in OpenGL; they are turned about x when they are read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.geometry.lens import AnyCamera
from conformodal.io.cameras import UNDISTORT, Size, camera_of, fisheye_of
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import matrix_faults, table_of
from conformodal.io.reading import MALFORMED, SUFFIXES, Note, by_name, file_named, read_lines, times_by_folder

FILES = ("transforms.json", "transforms_train.json")
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_LENS, _FISHEYE_LENS = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_ANGLES = ("camera_angle_x", "camera_angle_y")
_WORDS = ("camera_model", "is_fisheye")
_CAMERA_KEYS = ("fl_x", "fl_y", *_ANGLES, "cx", "cy", "w", "h", "k4", *_LENS, *_WORDS)
_AGREE = 0.02  # of focal length and field of view
_FISHEYE = "OPENCV_FISHEYE"
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE", _FISHEYE)


def transforms_file(folder: Path) -> Path | None:
    """The file of frames in a folder: ``transforms.json``, or else that of the training frames."""
    return next((folder / name for name in FILES if (folder / name).is_file()), None)


def read_nerf(folder: Path) -> FrameTable:
    """Read the frames of ``transforms.json``, or else of ``transforms_train.json``, in the order of their file names.

    They share one camera. Times are those of ``times.txt`` (seconds, one per line), or else even (``frame-rate.txt``
    in Hz, or 30). World and scale are the file's own, unless
    ``metres-per-unit.txt`` gives one. Fisheye images are undistorted, once.
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


def _camera(path: Path, values: dict[str, Any], size: Size, notes: list[Note]) -> AnyCamera:
    model = values.get("camera_model", _FISHEYE if values.get("is_fisheye") else "OPENCV")
    fisheye = model == _FISHEYE
    unclear = values.get("p1") or values.get("p2") if fisheye else values.get("k4") or values.get("is_fisheye")
    if model not in _MODELS or unclear or (fisheye and "fl_x" not in values):  # whose angles are not a pinhole's
        raise DatasetError(
            f"{path}: has camera_model {str(model)[:40]} with {', '.join(sorted(values))}; expected one of "
            f"{', '.join(_MODELS)}, k4 with {_FISHEYE} alone, and p1, p2 without it: {UNDISTORT}"
        )
    if ("w" in values) != ("h" in values) or not all(0 < values.get(name, 1.0) < np.pi for name in _ANGLES):
        raise DatasetError(f"{path}: expected both w and h or none, and camera_angle_x in radians between 0 and 3.14")
    whole = (round(values["w"]), round(values["h"])) if "w" in values else size
    angles = {name: whole[k] / np.tan(values[name] / 2) / 2 for k, name in enumerate(_ANGLES) if name in values}
    fx = values.get("fl_x", values.get("fl_y", angles.get(_ANGLES[0], angles.get(_ANGLES[1]))))
    fy = values.get("fl_y", values.get("fl_x", angles.get(_ANGLES[1], fx)))
    if fx is None or fy is None or abs(angles.get(_ANGLES[0], fx) / fx - 1) > _AGREE:
        raise DatasetError(
            f"{path}: has fl_x {fx} and camera_angle_x {values.get(_ANGLES[0])}, expected one or both alike"
        )
    # the first pixel's centre is (0.5, 0.5), as in COLMAP; OpenCV's is (0, 0)
    pixels = fx, fy, values.get("cx", whole[0] / 2) - 0.5, values.get("cy", whole[1] / 2) - 0.5
    make, names = (fisheye_of, _FISHEYE_LENS) if fisheye else (camera_of, _LENS)
    lens = tuple(values.get(name, 0.0) for name in names)
    lens = lens if fisheye or lens[4] else lens[:4]
    return make(f"{path}: fl_x, fl_y, cx, cy", pixels, size, lens, stated=whole, notes=notes)
