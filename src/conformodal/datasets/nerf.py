"""NeRF's ``transforms.json`` (Mildenhall et al. 2020; Mueller et al. 2022): one file with camera and poses.

Its cameras look along -z with y up, as in OpenGL; they are turned about x when they are read.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.poses import PinholeCamera, PoseError, Trajectory

from .errors import DatasetError
from .files import even_times, image_size, read_lines
from .sequence import Sequence

FILE = "transforms.json"
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
_OWN_CAMERA = ("fl_x", "fl_y", "cx", "cy")


def read_nerf(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read the frames of a ``transforms.json``, in the order of their file names, without decoding them.

    Parameters
    ----------
    folder
        With ``transforms.json``. ``frame-rate.txt`` (Hz) gives the frames their times, else 30 a second. The scale is
        the file's own.
    require_poses
        Every frame has a pose, so it makes no difference.

    Raises
    ------
    DatasetError
        If the file is missing or damaged, a frame has no image or its own camera, or a pose is no rigid motion.
    """
    folder = Path(folder).resolve()
    path = folder / FILE
    try:
        content: Any = json.loads("\n".join(read_lines(path)))
        frames = sorted(content["frames"], key=lambda frame: str(frame["file_path"]))
        poses = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64)
    except (ValueError, KeyError, TypeError) as exc:
        raise DatasetError(f"{path}: is no NeRF file: {type(exc).__name__}: {exc}") from exc
    if not frames or poses.shape != (len(frames), 4, 4):
        raise DatasetError(f"{path}: needs frames with 4x4 matrices, found shape {poses.shape}")
    own = [str(f["file_path"]) for f in frames if any(f.get(k, content.get(k)) != content.get(k) for k in _OWN_CAMERA)]
    if own:
        raise DatasetError(f"{path}: {own[0]} has a camera of its own; expected one camera for all frames")
    images = tuple(_image(folder, path, str(frame["file_path"])) for frame in frames)
    times = even_times(folder, len(frames))
    try:
        truth = Trajectory.from_poses_se3(times, poses @ OPENGL_AXES)
    except PoseError as exc:
        raise DatasetError(f"{path}: {exc}") from exc
    recording = np.zeros(len(frames), dtype=np.int64)
    return Sequence(folder.name, images, times, recording, _camera(path, content, image_size(images[0])), truth)


def _image(folder: Path, path: Path, name: str) -> Path:
    found = next((folder / f"{name}{suffix}" for suffix in _SUFFIXES if (folder / f"{name}{suffix}").is_file()), None)
    if found is None:
        raise DatasetError(f"{path}: names {name}, but there is no such image in {folder}")
    return found


def _camera(path: Path, content: dict[str, Any], size: tuple[int, int]) -> PinholeCamera:
    width, height = size
    try:
        if "fl_x" in content:
            fx = float(content["fl_x"])
        else:
            fx = float(0.5 * width / np.tan(0.5 * float(content["camera_angle_x"])))
        fy = float(content.get("fl_y", fx))
        cx, cy = float(content.get("cx", width / 2)), float(content.get("cy", height / 2))
        lens = tuple(float(content.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2"))
        return PinholeCamera(fx, fy, cx, cy, width, height, lens if any(lens) else ())
    except (KeyError, TypeError, ValueError, PoseError) as exc:
        raise DatasetError(f"{path}: says no camera (fl_x or camera_angle_x): {type(exc).__name__}: {exc}") from exc
