"""NeRF's ``transforms.json`` (Mildenhall et al. 2020; Mueller et al. 2022): one file with camera and poses.

Its cameras look along -z with y up, as in OpenGL; they are turned about x when they are read.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.io.cameras import UNDISTORT, Size, camera_of
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.lenses import AnyCamera, as_stored, fisheye_of
from conformodal.io.pose_text import matrix_faults, number, table_of
from conformodal.io.reading import MALFORMED, SUFFIXES, Note, PathGuard, by_name, read_lines, reader, times_by_folder
from conformodal.io.recording import Recording

FILE = "transforms.json"
ORIGINAL_WORLD = "poses are in the original world"
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_SUFFIXES = ("", *SUFFIXES, *map(str.upper, SUFFIXES))
_LENS = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE, _FISHEYE_LENS = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")
_FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_OWN_CAMERA = (*_FOCAL, "cx", "cy", "w", "h", "camera_model", "is_fisheye", "k4", *_LENS)
_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


@reader
def read_nerf(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Recording:
    """Read the frames of a ``transforms.json``, in the natural order of their file names, without decoding them.

    Parameters
    ----------
    folder
        With ``transforms.json``, or only ``transforms_train.json``; a frame may have a camera of its own. Times are
        those of ``times.txt`` (seconds, one a line), or else even (``frame-rate.txt`` in Hz, or 30). The scale is the
        file's own; what nerfstudio's ``applied_transform`` did is undone. Fisheye images are undistorted, once.
    require_poses
        True leaves out frames without an image, or whose pose is missing or no rigid motion. False keeps them.
    follow_outside
        Whether the file may name images outside the folder.
    """
    folder = Path(folder).resolve()
    path = transforms_file(folder) or folder / FILE
    notes: list[Note] = []
    if path.name != FILE and (others := sorted(p.name for p in folder.glob("transforms_*.json") if p != path)):
        notes.append(Note("other frames are not read", f"{path}: is read, and {', '.join(others)} beside it are not"))
    try:
        content: Any = json.loads("\n".join(read_lines(path)))
        frames = by_name(content["frames"], lambda frame: str(frame["file_path"]), notes)
        poses = np.array([_matrix(frame.get("transform_matrix")) for frame in frames], dtype=np.float64)
        world = _original_world(path, content)
        cameras = [_stated(content, frame) for frame in frames]
    except DatasetError:
        raise
    except MALFORMED as exc:
        raise DatasetError(f"{path}: is no NeRF file: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if not frames:
        raise DatasetError(f"{path}: needs frames with 4x4 matrices, found none")
    names = [str(frame["file_path"]) for frame in frames]
    place = PathGuard(folder, path, follow_outside=follow_outside)
    images = [_image(place, name) for name in names]
    if not any(map(os.path.isfile, images)):  # False for names that are too long, too
        raise DatasetError(f"{path}: names {names[0]}, but there is no such image in {folder}")
    first: dict[Any, str] = {}
    for name, image in zip(names, images, strict=True):
        there = image.stat() if os.path.isfile(image) else None
        key = os.path.realpath(image) if there is None else (there.st_dev, there.st_ino)
        if (other := first.setdefault(key, name)) is not name:
            raise DatasetError(f"{path}: names {other} twice, as {name} too; expected one pose for an image")
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    unknown = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2))).tolist()
    why = {i: f"{path}: transform_matrix {faults.get(i, 'is missing, or holds NaN or infinity')}" for i in unknown}
    poses[unknown] = np.nan
    if world is not None:
        turn, shift, scale = world
        poses[:, :3, 3] = (poses[:, :3, 3] / scale - shift) @ turn  # the inverse of x -> scale (turn x + shift)
        poses[:, :3, :3] = turn.T @ poses[:, :3, :3]
        notes.append(Note(ORIGINAL_WORLD, f"{path}: applied_transform and applied_scale are undone"))
    poses = table_of(poses * np.diag(OPENGL_AXES))  # turns the columns
    times, recording = times_by_folder(folder, images)
    images = as_stored(images, [_wide(camera) for camera in cameras], "NeRF", notes)
    lenses = _cameras(path, cameras, images, notes)
    table = FrameTable(folder.name, images, times, recording, poses, why, notes)
    return table.sequence(lenses, require_poses=require_poses)


def transforms_file(folder: Path) -> Path | None:
    """The file of frames in a folder: ``transforms.json``, or else that of the training frames."""
    return next((folder / name for name in (FILE, "transforms_train.json") if (folder / name).is_file()), None)


def _stated(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The camera of a frame: its values replace those on top, and one focal length or angle replaces all of them."""
    own = {k: frame[k] for k in _OWN_CAMERA if k in frame}
    replaced = _FOCAL if any(own.get(k) is not None for k in _FOCAL) else ()
    stated = {k: v for k, v in content.items() if k not in replaced} | own
    return {k: v for k, v in stated.items() if v is not None}


def _wide(camera: dict[str, Any]) -> bool | None:
    """Whether a camera's images are wider than high; None if it does not say."""
    with suppress(KeyError, ValueError):
        return _number(camera["w"]) > _number(camera["h"])
    return None


def _cameras(path: Path, stated: list[dict[str, Any]], images: list[Path], notes: list[Note]) -> list[AnyCamera]:
    """The camera of every frame; equal ones are made, and looked at, once."""
    keys = [repr([camera.get(k) for k in _OWN_CAMERA]) for camera in stated]
    made: dict[str, AnyCamera] = {}
    for key, camera in zip(keys, stated, strict=True):
        if key not in made:
            there = [image for image, other in zip(images, keys, strict=True) if other == key and os.path.isfile(image)]
            size = common_size(there or [image for image in images if image.is_file()])
            made[key] = _camera(path, camera, size, notes)
    return [made[key] for key in keys]


def _original_world(path: Path, content: dict[str, Any]) -> tuple[FloatArray, FloatArray, float] | None:
    """Rotation, shift and scale by which nerfstudio has moved the original world, if it has."""
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    moved = np.eye(4)
    rows = content.get("applied_transform", moved[:3].tolist())
    moved[:3] = np.array([[_number(v) for v in row] for row in rows], dtype=np.float64)[:3]
    scale = _number(content.get("applied_scale", 1.0))
    if fault := matrix_faults(moved[None]).get(0, "" if np.isfinite(moved).all() else "holds NaN or infinity"):
        raise DatasetError(f"{path}: applied_transform {fault}, expected a rigid motion")
    if not 0 < scale < np.inf:
        raise DatasetError(f"{path}: applied_scale is {scale}, expected a positive number")
    return moved[:3, :3], moved[:3, 3], scale


def _matrix(rows: Any) -> list[list[float]]:
    if rows is None:  # a frame without a pose
        return [[float("nan")] * 4] * 4
    found = [[_number(v) for v in row] for row in rows if isinstance(row, list)]
    found += [[0.0, 0.0, 0.0, 1.0]] if len(found) == 3 else []
    if not isinstance(rows, list) or [len(row) for row in found] != [4] * 4:
        raise ValueError("transform_matrix must be a list of 4 lists of 4 numbers")
    return found


def _number(value: Any) -> float:
    if isinstance(value, str):
        return number(value)
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
        if ("w" in content) != ("h" in content):
            raise ValueError("found only one of 'w' and 'h'")
        if "w" in content:
            stated = round(_number(content["w"])), round(_number(content["h"]))
        width, height = stated or size
        sides = {"x": width, "y": height}
        focal = {
            axis: _number(content[f"fl_{axis}"])
            if f"fl_{axis}" in content
            else _focal(path, f"camera_angle_{axis}", content, side, notes)
            for axis, side in sides.items()
            if f"fl_{axis}" in content or (f"camera_angle_{axis}" in content and "fl_x" not in content)
        }
        if not focal:
            raise ValueError("found neither, nor fl_y or camera_angle_y")
        fx, fy = focal.get("x", focal.get("y", 0.0)), focal.get("y", focal.get("x", 0.0))
        cx, cy = _number(content.get("cx", width / 2)), _number(content.get("cy", height / 2))
        lens = tuple(_number(content.get(k, 0.0)) for k in (_FISHEYE_LENS if fisheye else _LENS))
    except DatasetError:
        raise
    except (ValueError, OverflowError) as exc:
        raise DatasetError(f"{path}: says no camera (fl_x or camera_angle_x): {exc}") from exc
    source, pixels = f"{path}: fl_x, fl_y, cx, cy", (fx, fy, cx, cy)
    if fisheye:
        return fisheye_of(source, pixels, size, lens, stated=stated, notes=notes)
    lens = lens if lens[4] else lens[:4]
    return camera_of(source, pixels, size, lens if any(lens) else (), stated=stated, notes=notes)


def _focal(path: Path, name: str, content: dict[str, Any], side: int, notes: list[Note]) -> float:
    """Focal length of a field of view; what is too large for radians is degrees."""
    angle = _number(content[name])
    if np.pi <= angle < 180:
        notes.append(Note("angle is in degrees", f"{path}: {name} = {angle:g} is read as degrees, expected radians"))
        angle = float(np.radians(angle))
    if not 0 < angle < np.pi:
        raise DatasetError(f"{path}: {name} is {angle:g}, expected radians between 0 and 3.14")
    return float(0.5 * side / np.tan(0.5 * angle))


def _is_fisheye(path: Path, content: dict[str, Any]) -> bool:
    """Whether the file says a fisheye lens; refuses what it does not say clearly."""
    if other := next((key for key in content if "distort" in key and content[key]), None):
        raise DatasetError(f"{path}: has {other[:40]}; expected the lens as {', '.join(_LENS)}")
    model = content.get("camera_model", _FISHEYE if content.get("is_fisheye") else "OPENCV")
    if model == _FISHEYE:
        if "fl_x" not in content or content.get("p1") or content.get("p2"):
            raise DatasetError(f"{path}: has camera_model {_FISHEYE}; expected fl_x with it, and neither p1 nor p2")
        return True
    if model not in _MODELS or content.get("is_fisheye") or content.get("k4"):
        what = f"k4 without camera_model {_FISHEYE}" if model in _MODELS else f"camera_model {str(model)[:40]}"
        raise DatasetError(f"{path}: has {what}; expected one of {', '.join((*_MODELS, _FISHEYE))}: {UNDISTORT}")
    return False
