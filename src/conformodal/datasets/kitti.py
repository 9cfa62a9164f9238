"""KITTI odometry (Geiger, Lenz and Urtasun 2012): ``sequences/NN/image_0`` and ``poses/NN.txt``.

Poses are those of the left grey camera, camera 0. The colour camera ``image_2`` stands beside it; its poses are moved
by what ``calib.txt`` says.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera, Trajectory, TrajectoryFileError, read_kitti

from .errors import DatasetError
from .files import image_size, read_lines, read_numbers
from .sequence import Sequence

FRAME_RATE_HZ = 10.0
_CAMERAS = ("image_2", "image_0")  # colour where it is there


def read_kitti_odometry(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read a sequence, without decoding images.

    Parameters
    ----------
    folder
        ``.../sequences/NN``, with ``image_2`` or ``image_0``, ``calib.txt`` and perhaps ``times.txt``. Poses are
        looked for in ``.../poses/NN.txt`` and in ``NN.txt``, ``poses.txt`` in the folder itself.
    require_poses
        False also reads a sequence without poses.

    Raises
    ------
    DatasetError
        If something is missing or damaged, or numbers of images, times and poses do not fit. Names the file.
    """
    folder = Path(folder).resolve()
    camera = next((name for name in _CAMERAS if (folder / name).is_dir()), None)
    if camera is None:
        raise DatasetError(f"{folder}: holds neither image_2 nor image_0; expected a KITTI odometry sequence")
    images = sorted(p for p in (folder / camera).iterdir() if p.suffix in (".png", ".jpg"))
    if not images:
        raise DatasetError(f"{folder / camera}: holds no image")
    width, height = image_size(images[0])
    projection = _projection(folder / "calib.txt", f"P{camera[-1]}")
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    intrinsics = PinholeCamera(fx, fy, cx, cy, width, height)
    times = np.arange(len(images), dtype=np.float64) / FRAME_RATE_HZ
    if (folder / "times.txt").is_file():
        times = read_numbers(folder / "times.txt")
        if times.size != len(images):
            raise DatasetError(f"{folder / 'times.txt'}: holds {times.size} times for {len(images)} images")
    # P = K [I | offset]: where camera 0's centre lies for this one
    offset = np.asarray(np.linalg.solve(projection[:, :3], projection[:, 3]), dtype=np.float64)
    truth = _truth(folder, times, offset, require_poses)
    recording = np.zeros(len(images), dtype=np.int64)
    return Sequence(f"kitti {folder.name}", tuple(images), times, recording, intrinsics, truth)


def _projection(path: Path, name: str) -> npt.NDArray[np.float64]:
    for line in read_lines(path):
        if line.startswith(f"{name}:"):
            try:
                values = np.array([float(x) for x in line.split()[1:]])
            except ValueError:
                values = np.empty(0)
            if values.size != 12 or not np.isfinite(values).all() or not values[0] > 0:
                raise DatasetError(f"{path}: {name} must be twelve numbers (3x4), got {line[:80]!r}")
            return values.reshape(3, 4)
    raise DatasetError(f"{path}: has no line {name}:")


def _truth(
    folder: Path, times: npt.NDArray[np.float64], offset: npt.NDArray[np.float64], required: bool
) -> Trajectory | None:
    places = [
        folder.parent.parent / "poses" / f"{folder.name}.txt",
        folder / f"{folder.name}.txt",
        folder / "poses.txt",
    ]
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        if required:
            raise DatasetError(f"{places[0]}: poses are missing")
        return None
    try:
        grey = read_kitti(path, times)
    except TrajectoryFileError as exc:
        raise DatasetError(str(exc)) from exc
    poses = grey.poses_se3
    poses[:, :3, 3] -= poses[:, :3, :3] @ offset
    return Trajectory.from_poses_se3(times, poses)
