"""KITTI odometry (Geiger, Lenz and Urtasun 2012): ``sequences/NN/image_0`` and ``poses/NN.txt``.

Poses are those of the left grey camera, camera 0. The colour camera ``image_2`` stands beside it; its poses are moved
by what ``calib.txt`` says.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.io.cameras import camera_of, check_matrix
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable
from conformodal.io.pose_files import KITTI_RATE_HZ, kitti_table, matrices_of, table_of
from conformodal.io.reading import Note, image_files, number, numbers_of, read_lines, read_numbers, rows_of

CAMERAS = ("image_2", "image_0", "image_3", "image_1")  # colour where it is there; the left one first


def looks_like_kitti(folder: Path) -> bool:
    """Whether a folder holds ``calib.txt`` and images of a camera."""
    return (folder / "calib.txt").is_file() and any((folder / name).is_dir() for name in CAMERAS)


def read_kitti_odometry(folder: Path) -> FrameTable:
    """Read ``.../sequences/NN``, with one of ``CAMERAS``, ``calib.txt`` and perhaps ``times.txt``.

    Poses are those of ``.../poses/NN.txt``, or of ``NN.txt`` or ``poses.txt`` in the folder itself. Images whose names
    are numbers may be fewer than poses and times: an image's number is then its line, counted from 0.
    """
    place = next((folder / name for name in CAMERAS if (folder / name).is_dir()), None)
    if place is None:
        raise DatasetError(f"{folder}: holds none of {', '.join(CAMERAS)}; expected a KITTI odometry sequence")
    notes: list[Note] = []
    images = image_files(place)
    if not images:
        raise DatasetError(f"{place}: holds no image")
    calibration, name = folder / "calib.txt", f"P{place.name[-1]}"
    projection = _projection(calibration, name)
    pixels = projection[[0, 1, 0, 1], [0, 1, 2, 2]]
    camera = camera_of(f"{calibration}: {name}", pixels, common_size(images), notes=notes)
    files = [folder.parent.parent / "poses" / f"{folder.name}.txt", folder / f"{folder.name}.txt", folder / "poses.txt"]
    path = next((file for file in files if file.is_file()), None)
    why: Damaged = {}
    if path is None:
        poses, numbers = None, numbers_of(images)
        frames = np.arange(len(images)) if numbers is None else numbers
    else:
        table = kitti_table(path)
        frames = rows_of(images, len(table.rows), path, "poses, but there are")
        why |= {i: table.damaged[row] for i, row in enumerate(frames.tolist()) if row in table.damaged}
        grey = matrices_of(table.rows[frames])
        # P = K [I | offset]: where camera 0's centre lies for this one
        grey[:, :3, 3] -= grey[:, :3, :3] @ np.linalg.solve(projection[:, :3], projection[:, 3])
        poses = table_of(grey)
    times = frames / KITTI_RATE_HZ
    if (stamped := folder / "times.txt").is_file():
        stamps = read_numbers(stamped)
        times = stamps[rows_of(images, len(stamps), stamped, "times for")]
    return FrameTable(f"kitti {folder.name}", images, times, camera, poses, why=why, notes=notes, source=files[0])


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
