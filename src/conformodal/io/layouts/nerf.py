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
_SUFFIXES = (*SUFFIXES, *map(str.upper, SUFFIXES))
_LENS, _FISHEYE_LENS = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_CAMERA_KEYS = (*_FOCAL, "cx", "cy", "w", "h", "camera_model", "is_fisheye", "k4", *_LENS)
_FISHEYE = "OPENCV_FISHEYE"
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE", _FISHEYE)


def transforms_file(folder: Path) -> Path | None:
    """The file of frames in a folder: ``transforms.json``, or else that of the training frames."""
    return next((folder / name for name in FILES if (folder / name).is_file()), None)


def read_nerf(folder: Path) -> FrameTable:
    """Read the frames of ``transforms.json``, or else of ``transforms_train.json``, in the order of their file names.

    A frame may have a camera of its own. Times are those of ``times.txt`` (seconds, one per line), or else even
    (``frame-rate.txt`` in Hz, or 30). World and scale are the file's own. Fisheye images are undistorted, once.
    """
    path = transforms_file(folder) or folder / FILES[0]
    notes: list[Note] = []
    if path.name != FILES[0] and (others := sorted(p.name for p in folder.glob("transforms_*.json") if p != path)):
        notes.append(Note("other frames are not read", f"{path}: is read, and {', '.join(others)} beside it are not"))
    try:
        content: Any = json.loads("\n".join(read_lines(path)))
        frames = by_name(content["frames"], lambda frame: str(frame["file_path"]))
        poses = np.array([_matrix(frame.get("transform_matrix")) for frame in frames], dtype=np.float64)
        cameras = [_stated(content, frame) for frame in frames]
    except MALFORMED as exc:
        raise DatasetError(f"{path}: is not a NeRF file: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if not frames:
        raise DatasetError(f"{path}: needs frames with 4x4 matrices, found none")
    names = [str(frame["file_path"]) for frame in frames]
    images = [_image(folder, name) for name in names]
    if not any(map(os.path.isfile, images)):
        raise DatasetError(f"{path}: names {names[0]}, but there is no such image in {folder}")
    first: dict[str, str] = {}
    for name, image in zip(names, images, strict=True):
        if (other := first.setdefault(os.path.realpath(image), name)) is not name:
            raise DatasetError(f"{path}: names {other} twice, as {name} too; expected one pose per image")
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    unposed = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2))).tolist()
    why = {i: f"{path}: transform_matrix {faults.get(i, 'is missing, or holds NaN or infinity')}" for i in unposed}
    poses[unposed] = np.nan
    rows = table_of(poses * np.diag(OPENGL_AXES))  # turns the columns
    times, recording = times_by_folder(folder, images)
    lenses = _cameras(path, cameras, images, notes)
    table = FrameTable(folder.name, images, times, lenses, rows, recording, why=why, notes=notes)
    table.root, table.source, table.as_stored = folder, path, True
    return table


def _matrix(rows: Any) -> list[list[float]]:
    """Four rows of four numbers; NaN for a frame without a pose."""
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
    whole = file_named(folder, name)
    named = (whole, *(whole.with_name(f"{whole.name}{suffix}") for suffix in _SUFFIXES if whole.name))
    return next((path for path in named if os.path.lexists(path)), whole)


def _stated(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The camera of a frame: its values replace those on top, and one focal length or angle replaces all of them."""
    of_frame = {k: frame[k] for k in _CAMERA_KEYS if frame.get(k) is not None}
    replaced = _FOCAL if any(k in of_frame for k in _FOCAL) else ()
    camera = {k: content[k] for k in _CAMERA_KEYS if content.get(k) is not None and k not in replaced} | of_frame
    if (other := next((k for k in content if "distort" in k and content[k]), None)) is not None:
        raise ValueError(f"has {other[:40]}, expected the lens as {', '.join(_LENS)}")
    named = {k: camera.pop(k) for k in ("camera_model", "is_fisheye") if k in camera}
    numbers = {k: _number(v) for k, v in camera.items()}
    if not np.isfinite(list(numbers.values())).all():
        raise ValueError(f"its camera holds NaN or infinity: {numbers}")
    return numbers | named


def _cameras(path: Path, stated: list[dict[str, Any]], images: list[Path], notes: list[Note]) -> list[AnyCamera]:
    """The camera of every frame; equal ones are made, and looked at, once."""
    keys = [repr(sorted(camera.items())) for camera in stated]
    made: dict[str, AnyCamera] = {}
    for key, camera in zip(keys, stated, strict=True):
        if key not in made:
            there = [image for image, other in zip(images, keys, strict=True) if other == key and os.path.isfile(image)]
            made[key] = _camera(path, camera, common_size(there or images), notes)
    return [made[key] for key in keys]


def _camera(path: Path, stated: dict[str, Any], size: Size, notes: list[Note]) -> AnyCamera:
    fisheye = _is_fisheye(path, stated)
    if ("w" in stated) != ("h" in stated):
        raise DatasetError(f"{path}: says only one of 'w' and 'h' of a camera")
    whole = (round(stated["w"]), round(stated["h"])) if "w" in stated else size
    focal = {axis: _focal(path, stated, axis, side) for axis, side in zip("xy", whole, strict=True)}
    fx, fy = (focal[axis] if focal[axis] is not None else focal[other] for axis, other in ("xy", "yx"))
    if fx is None or fy is None:
        raise DatasetError(f"{path}: says no camera, expected fl_x or camera_angle_x")
    pixels = fx, fy, stated.get("cx", whole[0] / 2), stated.get("cy", whole[1] / 2)
    lens = tuple(stated.get(k, 0.0) for k in (_FISHEYE_LENS if fisheye else _LENS))
    make, lens = (fisheye_of, lens) if fisheye else (camera_of, lens if lens[4] else lens[:4])
    return make(f"{path}: fl_x, fl_y, cx, cy", pixels, size, lens, stated=whole, notes=notes)


def _focal(path: Path, stated: dict[str, Any], axis: str, side: int) -> float | None:
    """Focal length along an axis, or that of a field of view; None where neither is said."""
    if f"fl_{axis}" in stated:
        return float(stated[f"fl_{axis}"])
    name = f"camera_angle_{axis}"
    if name not in stated or "fl_x" in stated:
        return None
    if not 0 < stated[name] < np.pi:
        raise DatasetError(f"{path}: {name} is {stated[name]:g}, expected radians between 0 and 3.14")
    return float(0.5 * side / np.tan(0.5 * stated[name]))


def _is_fisheye(path: Path, stated: dict[str, Any]) -> bool:
    """Whether the file says a fisheye lens; refuses what it does not say clearly."""
    model = stated.get("camera_model", _FISHEYE if stated.get("is_fisheye") else "OPENCV")
    fisheye = model == _FISHEYE
    unclear = stated.get("p1") or stated.get("p2") if fisheye else stated.get("k4") or stated.get("is_fisheye")
    if model not in _MODELS or unclear or (fisheye and "fl_x" not in stated):
        raise DatasetError(
            f"{path}: has camera_model {str(model)[:40]} with {', '.join(sorted(stated))}; expected one of "
            f"{', '.join(_MODELS)}, k4 with {_FISHEYE} alone, and p1, p2 without it: {UNDISTORT}"
        )
    return bool(fisheye)
