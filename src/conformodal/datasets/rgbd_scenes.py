"""RGB-D Scenes v2 (Lai, Bo and Fox 2014), the paper's data set: ``imgs/scene_NN`` and ``pc/NN.pose``.

A line of a pose file is ``qw qx qy qz x y z``, camera to world, one a frame.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera, PoseError, Trajectory

from .errors import DatasetError
from .files import camera_beside, image_size, read_lines
from .sequence import Sequence

CAMERA = PinholeCamera(570.3, 570.3, 320.0, 240.0, 640, 480)
FRAME_RATE_HZ = 30.0
_GAP_BETWEEN_SCENES_S = 10.0
_IMAGE = re.compile(r"(\d+)-color\.png$")
_SCENE = re.compile(r"scene_(\d+)$")


def read_rgbd_scenes(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read a scene, or all scenes, without decoding images.

    Parameters
    ----------
    folder
        ``.../imgs/scene_NN``, or the folder that holds ``imgs`` and ``pc``; every scene is a recording.
    require_poses
        False also reads scenes without pose files; the sequence then has no truth.

    Raises
    ------
    DatasetError
        If something is missing or damaged, or there are more images than poses. Names the file.
    """
    folder = Path(folder).resolve()
    scenes = [folder] if _SCENE.search(folder.name) else sorted((folder / "imgs").glob("scene_*"))
    if not scenes:
        raise DatasetError(f"{folder}: holds no imgs/scene_NN; expected RGB-D Scenes v2")
    images: list[Path] = []
    times: list[float] = []
    owner: list[int] = []
    poses: list[npt.NDArray[np.float64]] = []
    start, missing = 0.0, 0
    for number, scene in enumerate(scenes):
        frames = {int(m[1]): p for p in scene.iterdir() if (m := _IMAGE.search(p.name))}
        if not frames:
            raise DatasetError(f"{scene}: holds no FFFFF-color.png")
        order = sorted(frames)
        images += [frames[i] for i in order]
        times += [start + i / FRAME_RATE_HZ for i in order]
        owner += [number] * len(order)
        start = times[-1] + _GAP_BETWEEN_SCENES_S
        path = scene.parent.parent / "pc" / f"{scene.name.removeprefix('scene_')}.pose"
        if not path.is_file() and not require_poses:
            missing += 1
            continue
        poses.append(_poses(path, order))
    stamps = np.array(times)
    truth = None
    if not missing:
        rows = np.concatenate(poses)
        try:
            truth = Trajectory(stamps, rows[:, 4:], rows[:, :4])
        except PoseError as exc:
            raise DatasetError(f"{folder}: {exc}") from exc
    name = folder.name if scenes == [folder] else f"{folder.name} ({len(scenes)} scenes)"
    camera = camera_beside(folder, image_size(images[0]), CAMERA)
    return Sequence(name, tuple(images), stamps, np.array(owner, dtype=np.int64), camera, truth)


def _poses(path: Path, frames: list[int]) -> npt.NDArray[np.float64]:
    """Rows (n, 7) of the frames; a frame's number is its line."""
    rows = []
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            continue
        try:
            row = [float(x) for x in line.split()]
        except ValueError:
            row = []
        if len(row) != 7 or not np.isfinite(row).all() or not np.any(row[:4]):
            raise DatasetError(f"{path}, line {number}: expected 'qw qx qy qz x y z', got {line[:80]!r}")
        rows.append(row)
    if frames[-1] >= len(rows):
        raise DatasetError(f"{path}: holds {len(rows)} poses, but there is an image {frames[-1]} (counted from 0)")
    return np.array(rows)[frames]
