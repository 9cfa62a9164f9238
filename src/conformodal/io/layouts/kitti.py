"""KITTI odometry (Geiger, Lenz and Urtasun 2012): ``sequences/NN/image_0`` and ``poses/NN.txt``.

Poses are those of the left grey camera, camera 0. The colour camera ``image_2`` stands beside it; its poses are moved
by what ``calib.txt`` says.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import rigid_motions
from conformodal.geometry.poses import matrices_of, table_of
from conformodal.io.cameras import camera_of
from conformodal.io.decoding import common_size
from conformodal.io.diagnosis.cameras import check_matrix
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import PoseRows, matrix_faults
from conformodal.io.reading import (
    Note,
    image_files,
    number,
    numbers_in,
    parse_lines,
    read_lines,
    read_numbers,
    whole_number,
)

RATE_HZ = 10.0
CAMERAS = ("image_2", "image_0", "image_3", "image_1")  # colour where it is there; the left one first


def looks_like_kitti(folder: Path) -> bool:
    """Whether a folder holds ``calib.txt`` and images of a camera."""
    return (folder / "calib.txt").is_file() and any((folder / name).is_dir() for name in CAMERAS)


def read_kitti_odometry(folder: Path) -> FrameTable:
    """Read ``.../sequences/NN``, with one of ``CAMERAS``, ``calib.txt`` and perhaps ``times.txt``.

    Poses are those of ``.../poses/NN.txt``, or of ``NN.txt`` or ``poses.txt`` in the folder itself. An image's number
    is its line in poses and times, counted from 0.
    """
    place = next((folder / name for name in CAMERAS if (folder / name).is_dir()), None)
    images = [] if place is None else image_files(place)
    if place is None or not images:
        raise DatasetError(f"{folder}: holds no image in {', '.join(CAMERAS)}; expected a KITTI odometry sequence")
    notes: list[Note] = []
    calibration, name = folder / "calib.txt", f"P{place.name[-1]}"
    projection = _projection(calibration, name)
    pixels = projection[[0, 1, 0, 1], [0, 1, 2, 2]]
    camera = camera_of(f"{calibration}: {name}", pixels, common_size(images), notes=notes)
    try:
        frames = np.array([whole_number(image.stem) for image in images])
    except ValueError as exc:
        raise DatasetError(f"{place}: images must be called by their numbers, such as 000000.png ({exc})") from None
    stamped, times = folder / "times.txt", frames / RATE_HZ
    if stamped.is_file():
        stamps = read_numbers(stamped)
        times = stamps[_rows(frames, len(stamps), stamped)]
    files = [folder.parent.parent / "poses" / f"{folder.name}.txt", folder / f"{folder.name}.txt", folder / "poses.txt"]
    table = FrameTable(f"kitti {folder.name}", images, times, camera, notes=notes, source=files[0])
    if path := next((file for file in files if file.is_file()), None):
        poses = kitti_table(path)
        grey = matrices_of(poses.rows[_rows(frames, len(poses.rows), path)])
        # P = K [I | offset]: where camera 0's centre lies for this one
        grey[:, :3, 3] -= grey[:, :3, :3] @ np.linalg.solve(projection[:, :3], projection[:, 3])
        table.poses = table_of(grey)
        table.why = {i: poses.faults[row] for i, row in enumerate(frames.tolist()) if row in poses.faults}
    return table


def kitti_table(path: Path) -> PoseRows:
    """Rows (n, 7) of a file with the upper 3x4 of ``T_world_cam`` in each line, row by row."""
    rows = parse_lines(path, partial(numbers_in, count=12), "twelve numbers", by_line=True)
    upper = np.array(rows).reshape(-1, 3, 4)
    poses = rigid_motions(upper[:, :, :3], upper[:, :, 3])
    faults = matrix_faults(poses)
    poses[list(faults)] = np.nan
    table = PoseRows(path, table_of(poses))
    table.drop(faults)
    return table


def _rows(frames: IntArray, n_rows: int, path: Path) -> IntArray:
    """The numbers of images as lines of a file, which must have them."""
    if frames.max() >= n_rows:
        raise DatasetError(f"{path}: holds {n_rows} lines, but there is an image {frames.max()} (counted from 0)")
    return frames


def _projection(path: Path, name: str) -> FloatArray:
    line = next((line for line in read_lines(path) if line.startswith(f"{name}:")), "")
    try:
        projection = np.array([number(x) for x in line.split()[1:]]).reshape(3, 4)
    except ValueError:
        projection = np.full((3, 4), np.nan)
    if not np.isfinite(projection).all():
        raise DatasetError(f"{path}: expected '{name}:' with twelve numbers (3x4), got {line[:80]!r}")
    check_matrix(f"{path}: {name}", projection[:, :3])
    return projection
