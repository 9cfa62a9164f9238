"""TUM RGB-D (Sturm et al. 2012): ``rgb.txt`` lists images by time, ``groundtruth.txt`` poses by theirs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.poses import PinholeCamera, TrajectoryFileError, read_tum

from .errors import DatasetError
from .files import MAX_TIME_DIFFERENCE_S, camera_beside, image_size, poses_at, read_lines
from .sequence import Sequence

# Published calibrations of the three colour cameras; freiburg3's images have no distortion left.
CAMERAS = {
    "1": PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}


def read_tum_rgbd(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read a sequence, without decoding images.

    Parameters
    ----------
    folder
        With ``rgb.txt`` and ``groundtruth.txt``. The camera is that of freiburg1, 2 or 3 by the folder's name (``fr3``
        will do), unless ``camera-intrinsics.txt`` lies in it.
    require_poses
        True leaves out images without a pose within 0.02 s. False keeps all of them; the sequence has a truth only
        if every one has a pose.

    Raises
    ------
    DatasetError
        If something is missing or damaged, times go back, or no camera is known. Names the file.
    """
    folder = Path(folder).resolve()
    listed = folder / "rgb.txt"
    stamps, images = [], []
    for number, line in enumerate(read_lines(listed), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = line.split(maxsplit=1)
        try:
            stamps.append(float(fields[0]))
            images.append(folder / fields[1].strip())
        except (ValueError, IndexError):
            raise DatasetError(f"{listed}, line {number}: expected 'timestamp filename', got {line[:80]!r}") from None
    if not images:
        raise DatasetError(f"{listed}: lists no image")
    times = np.array(stamps)
    match = re.search(r"(?:freiburg|fr)([123])", folder.name)
    camera = camera_beside(folder, image_size(images[0]), CAMERAS[match[1]] if match else None)
    truth = None
    path = folder / "groundtruth.txt"
    if require_poses or path.is_file():
        try:
            known = read_tum(path)
        except TrajectoryFileError as exc:
            raise DatasetError(str(exc)) from exc
        frames, truth = poses_at(known, times, MAX_TIME_DIFFERENCE_S, path)
        if require_poses:
            images, times = [images[i] for i in frames], times[frames]
        elif len(frames) < len(images):
            truth = None
    return Sequence(folder.name, tuple(images), times, np.zeros(len(images), dtype=np.int64), camera, truth)
