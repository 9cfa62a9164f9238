"""KITTI odometry (Geiger, Lenz and Urtasun 2012): ``sequences/NN/image_0`` and ``poses/NN.txt``.

Poses are those of the left grey camera, camera 0. The colour camera ``image_2`` stands beside it; its poses are moved
by what ``calib.txt`` says.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import Trajectory
from conformodal.io.cameras import camera_of, check_matrix
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable, numbers_of, rows_of
from conformodal.io.pose_files import kitti_table
from conformodal.io.pose_text import number, table_of
from conformodal.io.reading import Note, image_files, read_lines, read_numbers, reader
from conformodal.io.recording import Recording

FRAME_RATE_HZ = 10.0
CAMERAS = ("image_2", "image_0", "image_3", "image_1")  # colour where it is there; the left one first


@reader
def read_kitti_odometry(folder: Path | str, *, require_poses: bool = True) -> Recording:
    """Read a sequence, without decoding images.

    Parameters
    ----------
    folder
        ``.../sequences/NN``, with one of ``CAMERAS``, ``calib.txt`` and perhaps ``times.txt``. Poses are
        looked for in ``.../poses/NN.txt`` and in ``NN.txt``, ``poses.txt`` in the folder itself. Images whose names
        are numbers may be fewer than poses and times: an image's number is then its line, counted from 0.
    require_poses
        False also reads a sequence without poses.
    """
    folder = Path(folder).resolve()
    camera = next((name for name in CAMERAS if (folder / name).is_dir()), None)
    if camera is None:
        raise DatasetError(f"{folder}: holds none of {', '.join(CAMERAS)}; expected a KITTI odometry sequence")
    notes: list[Note] = []
    images = image_files(folder / camera, notes)
    if not images:
        raise DatasetError(f"{folder / camera}: holds no image")
    calibration, name = folder / "calib.txt", f"P{camera[-1]}"
    projection = _projection(calibration, name)
    pixels = projection[[0, 1, 0, 1], [0, 1, 2, 2]]
    intrinsics = camera_of(f"{calibration}: {name}", pixels, common_size(images), notes=notes)
    path = folder / "times.txt"
    times: FloatArray | None = None
    if path.is_file():
        stamps = read_numbers(path)
        times = stamps[rows_of(images, len(stamps), path, "times for")]
    # P = K [I | offset]: where camera 0's centre lies for this one
    offset = np.asarray(np.linalg.solve(projection[:, :3], projection[:, 3]), dtype=np.float64)
    damaged: Damaged = {}
    frames, poses = _poses(folder, images, offset, require_poses, damaged)
    if times is None:
        times = frames / FRAME_RATE_HZ
    table = FrameTable(f"kitti {folder.name}", images, times, poses=poses, why=damaged, notes=notes)
    return table.sequence(intrinsics, require_poses=require_poses)


def _projection(path: Path, name: str) -> FloatArray:
    for line in read_lines(path):
        if line.startswith(f"{name}:"):
            try:
                values = np.array([number(x) for x in line.split()[1:]])
            except ValueError:
                values = np.empty(0)
            if values.size != 12 or not np.isfinite(values).all():
                raise DatasetError(f"{path}: {name} must be twelve numbers (3x4), got {line[:80]!r}")
            projection = values.reshape(3, 4)
            check_matrix(f"{path}: {name}", projection[:, :3])
            if min(projection[0, 0], projection[1, 1]) <= 0:
                raise DatasetError(f"{path}: {name} needs positive focal lengths, got {line[:80]!r}")
            return projection
    raise DatasetError(f"{path}: has no line {name}:")


def _poses(
    folder: Path, images: list[Path], offset: FloatArray, required: bool, damaged: Damaged
) -> tuple[IntArray, FloatArray | None]:
    """Numbers of the images, and their poses."""
    places = [
        folder.parent.parent / "poses" / f"{folder.name}.txt",
        folder / f"{folder.name}.txt",
        folder / "poses.txt",
    ]
    path = next((p for p in places if p.is_file()), None)
    if path is None:
        if required:
            raise DatasetError(f"{places[0]}: poses are missing")
        numbers = numbers_of(images)
        return np.arange(len(images)) if numbers is None else numbers, None
    faults: Damaged = {}
    rows = kitti_table(path, faults)
    numbers = rows_of(images, len(rows), path, "poses, but there are")
    damaged.update({i: faults[row] for i, row in enumerate(numbers.tolist()) if row in faults})
    found = rows[numbers]
    known = np.isfinite(found).all(axis=1)
    grey = Trajectory(np.zeros(int(known.sum())), found[known, :3], found[known, 3:]).poses_se3
    grey[:, :3, 3] -= grey[:, :3, :3] @ offset
    found[known] = table_of(grey)
    return numbers, found
