"""NeRF's ``transforms.json`` (Mildenhall et al. 2020; Mueller et al. 2022): one file with camera and poses.

Its cameras look along -z with y up, as in OpenGL; they are turned about x when they are read.
"""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.poses.text import matrix_faults, table_of

from .cameras import UNDISTORT, Size, camera_of
from .decoding import common_size, natural_key
from .errors import DatasetError
from .frame_table import FrameTable
from .lenses import AnyCamera, fisheye_of
from .reading import Note, PathGuard, frame_times, read_lines, reader
from .sequence import Sequence

FILE = "transforms.json"
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
_LENS = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE, _FISHEYE_LENS = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")
_OWN_CAMERA = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_model", "is_fisheye", "k4", *_LENS)
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


@reader
def read_nerf(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Sequence:
    """Read the frames of a ``transforms.json``, in the natural order of their file names, without decoding them.

    Parameters
    ----------
    folder
        With ``transforms.json``. Times are those of ``times.txt`` (seconds, one a line), or else even
        (``frame-rate.txt`` in Hz, or 30). The scale is the file's own. Fisheye images are undistorted, once.
    require_poses
        True leaves out frames without an image, or whose pose is missing or no rigid motion. False keeps them.
    follow_outside
        Whether the file may name images outside the folder.
    """
    folder = Path(folder).resolve()
    path = folder / FILE
    try:
        content: Any = json.loads("\n".join(read_lines(path)))
        frames = sorted(content["frames"], key=lambda frame: natural_key(str(frame["file_path"])))
        poses = np.array([_matrix(frame.get("transform_matrix")) for frame in frames], dtype=np.float64)
        own = [f for f in frames if any(k in f and f[k] != content.get(k) for k in _OWN_CAMERA)]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as exc:
        raise DatasetError(f"{path}: is no NeRF file: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if not frames:
        raise DatasetError(f"{path}: needs frames with 4x4 matrices, found none")
    names = [str(frame["file_path"]) for frame in frames]
    if own:
        raise DatasetError(f"{path}: {own[0]['file_path']} has a camera of its own; expected one camera for all frames")
    twice = next((a for a, b in pairwise(names) if a == b), None)
    if twice is not None:
        raise DatasetError(f"{path}: names {twice} twice, expected one pose for an image")
    place = PathGuard(folder, path, follow_outside=follow_outside)
    images = [_image(place, name) for name in names]
    if not any(image.is_file() for image in images):
        raise DatasetError(f"{path}: names {names[0]}, but there is no such image in {folder}")
    notes: list[Note] = []
    camera = _camera(path, content, common_size(images), notes)
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    unknown = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2))).tolist()
    why = {i: f"{path}: transform_matrix {faults.get(i, 'is missing, or holds NaN or infinity')}" for i in unknown}
    poses[unknown] = np.nan
    poses = table_of(poses * np.diag(OPENGL_AXES))  # turns the columns
    table = FrameTable(folder.name, images, frame_times(folder, len(frames)), poses=poses, why=why, notes=notes)
    return table.sequence(camera, require_poses=require_poses)


def _matrix(rows: Any) -> list[list[float]]:
    if rows is None:  # a frame without a pose
        return [[float("nan")] * 4] * 4
    found = [[_number(v) for v in row] for row in rows if isinstance(row, list)]
    if not isinstance(rows, list) or [len(row) for row in found] != [4] * 4:
        raise ValueError("transform_matrix must be a list of 4 lists of 4 numbers")
    return found


def _number(value: Any) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{str(value)[:40]!r} is no number")
    return float(value)


def _image(place: PathGuard, name: str) -> Path:
    whole = place(place.folder, name)
    found = (whole.with_name(f"{whole.name}{suffix}") for suffix in _SUFFIXES if whole.name)
    there = next((p for p in found if os.path.lexists(p)), whole)
    return place(there.parent, there.name)


def _camera(path: Path, content: dict[str, Any], size: Size, notes: list[Note]) -> AnyCamera:
    fisheye = _is_fisheye(path, content)
    try:
        stated = None
        if "w" in content or "h" in content:
            stated = round(_number(content["w"])), round(_number(content["h"]))
        width, height = stated or size
        if "fl_x" in content:
            fx = _number(content["fl_x"])
        else:
            fx = float(0.5 * width / np.tan(0.5 * _number(content["camera_angle_x"])))
        fy = _number(content.get("fl_y", fx))
        cx, cy = _number(content.get("cx", width / 2)), _number(content.get("cy", height / 2))
        lens = tuple(_number(content.get(k, 0.0)) for k in (_FISHEYE_LENS if fisheye else _LENS))
    except (KeyError, ValueError, OverflowError, ZeroDivisionError) as exc:
        raise DatasetError(f"{path}: says no camera (fl_x or camera_angle_x): {type(exc).__name__}: {exc}") from exc
    source, pixels = f"{path}: fl_x, fl_y, cx, cy", (fx, fy, cx, cy)
    if fisheye:
        return fisheye_of(source, pixels, size, lens, stated=stated, notes=notes)
    lens = lens if lens[4] else lens[:4]
    return camera_of(source, pixels, size, lens if any(lens) else (), stated=stated, notes=notes)


def _is_fisheye(path: Path, content: dict[str, Any]) -> bool:
    """Whether the file says a fisheye lens; refuses what it does not say clearly."""
    model = content.get("camera_model", _FISHEYE if content.get("is_fisheye") else "OPENCV")
    if model == _FISHEYE:
        if "fl_x" not in content or content.get("p1") or content.get("p2"):
            raise DatasetError(f"{path}: has camera_model {_FISHEYE}; expected fl_x with it, and neither p1 nor p2")
        return True
    if model not in _MODELS or content.get("is_fisheye") or content.get("k4"):
        what = f"k4 without camera_model {_FISHEYE}" if model in _MODELS else f"camera_model {str(model)[:40]}"
        raise DatasetError(f"{path}: has {what}; expected one of {', '.join((*_MODELS, _FISHEYE))}: {UNDISTORT}")
    return False
