"""A folder of images, with poses in a file beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.poses import Trajectory, TrajectoryFileError, read_kitti, read_tum

from .errors import DatasetError
from .files import MAX_TIME_DIFFERENCE_S, camera_beside, even_times, image_size, poses_at, read_numbers
from .sequence import Sequence

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_TUM, _KITTI = ("poses.tum", "groundtruth.txt"), ("poses.kitti", "poses.txt")
_NANOSECONDS = 1e14  # a time in seconds of this size would be the year three million


def image_files(folder: Path) -> list[Path]:
    """Image files of a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)


def read_image_folder(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read images of one camera, in the order of their names, without decoding them.

    Parameters
    ----------
    folder
        With the images and ``camera-intrinsics.txt`` (3x3). Times are those of ``times.txt`` (seconds, one a line),
        or the names of the files where all of these are numbers with a fraction or of nanoseconds, or else even
        (``frame-rate.txt`` in Hz, or 30). Poses: ``poses.tum`` (or ``groundtruth.txt``), the nearest within 0.02 s; or
        ``poses.kitti`` (or ``poses.txt``), a line an image.
    require_poses
        True leaves out images without a pose. False keeps all of them; there is a truth only if every one has a pose.

    Raises
    ------
    DatasetError
        If something is missing or damaged, or numbers of images, times and poses do not fit. Names the file.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; expected images")
    images = image_files(folder)
    if not images:
        raise DatasetError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    times = _times(folder, images)
    camera = camera_beside(folder, image_size(images[0]), None)
    try:
        frames, truth = _truth(folder, times)
    except TrajectoryFileError as exc:
        raise DatasetError(str(exc)) from exc
    if require_poses:
        if truth is None:
            raise DatasetError(f"{folder / _TUM[0]}: poses are missing (or {', '.join((*_TUM[1:], *_KITTI))})")
        images, times = [images[i] for i in frames], times[frames]
    elif len(frames) < len(images):
        truth = None
    return Sequence(folder.name, tuple(images), times, np.zeros(len(images), dtype=np.int64), camera, truth)


def _truth(folder: Path, times: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.int64], Trajectory | None]:
    for name in _TUM:
        if (folder / name).is_file():
            return poses_at(read_tum(folder / name), times, MAX_TIME_DIFFERENCE_S, folder / name)
    for name in _KITTI:
        if (folder / name).is_file():
            return np.arange(len(times)), read_kitti(folder / name, times)
    return np.arange(0), None


def _times(folder: Path, images: list[Path]) -> npt.NDArray[np.float64]:
    path = folder / "times.txt"
    if path.is_file():
        times = read_numbers(path)
        if times.size != len(images):
            raise DatasetError(f"{path}: holds {times.size} times for {len(images)} images")
        return times
    try:
        named = np.array([float(image.stem) for image in images])
    except ValueError:
        return even_times(folder, len(images))
    if (named > _NANOSECONDS).all():
        return named / 1e9
    return named if all("." in image.stem for image in images) else even_times(folder, len(images))
