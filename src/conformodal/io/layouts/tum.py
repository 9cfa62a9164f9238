"""TUM RGB-D (Sturm et al. 2012): ``rgb.txt`` lists images by time, ``groundtruth.txt`` poses by theirs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import tum_table
from conformodal.io.reading import Note, file_named, number, parse_lines

# Published calibrations of the three colour cameras; freiburg3's images have no distortion left.
CAMERAS = {
    "1": PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}
_NUMBERED = re.compile(r"(?<![A-Za-z])(?:freiburg|fr)([123])(?![0-9])")


def read_tum_rgbd(folder: Path) -> FrameTable:
    """Read a folder with ``rgb.txt`` and ``groundtruth.txt``.

    The camera is that of freiburg1, 2 or 3 by the folder's name (``fr3`` will do), unless ``camera-intrinsics.txt``
    lies in it.
    """
    path, truth = folder / "rgb.txt", folder / "groundtruth.txt"
    notes: list[Note] = []

    def parse(line: str) -> tuple[float, Path]:
        stamp, name = re.split(r"[,;\s]+", line.strip(), maxsplit=1)
        return number(stamp), file_named(folder, name.strip('" '))

    rows = parse_lines(path, parse, "'timestamp filename'")
    times, images = np.array([time for time, _ in rows]), [image for _, image in rows]
    match = _NUMBERED.search(folder.name)
    camera = camera_beside(folder, common_size(images), CAMERAS[match[1]] if match else None, notes)
    table = FrameTable(folder.name, images, times, camera, notes=notes, root=folder, source=truth)
    if truth.is_file():
        table.add_poses(tum_table, truth)
        table.source = path
    return table
