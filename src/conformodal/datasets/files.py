"""Small files that data sets are made of, with kind errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from conformodal.poses import PinholeCamera, PoseError, Trajectory, associate

from .errors import DatasetError, ImageError
from .sequence import read_image

FloatArray = npt.NDArray[np.float64]

FRAME_RATE_HZ = 30.0
# Poses are paired with images as near as this, as the TUM data set's own tool does.
MAX_TIME_DIFFERENCE_S = 0.02


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, without decoding the image.

    Raises
    ------
    ImageError
        If the file is missing or no image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except OSError:
        read_image(path)  # says kindly what is wrong
        raise ImageError(f"{path}: cannot be read") from None


def read_lines(path: Path) -> list[str]:
    """Lines of a text file.

    Raises
    ------
    DatasetError
        If it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as exc:
        raise DatasetError(f"{path}: cannot be read: {exc}") from exc


def read_numbers(path: Path) -> FloatArray:
    """All numbers of a text file, in one vector.

    Raises
    ------
    DatasetError
        If it cannot be read, or holds something else.
    """
    try:
        return np.array([float(x) for x in " ".join(read_lines(path)).split()])
    except ValueError as exc:
        raise DatasetError(f"{path}: cannot be read as numbers: {exc}") from exc


def camera_beside(folder: Path, size: tuple[int, int], default: PinholeCamera | None) -> PinholeCamera:
    """The camera of ``camera-intrinsics.txt`` (3x3) and ``camera-distortion.txt`` in a folder, or the default.

    Parameters
    ----------
    folder
        Where the files may lie.
    size
        Width and height of the images.
    default
        Taken where there is no file; None if the layout has no camera of its own.

    Raises
    ------
    DatasetError
        If the files are damaged, or there are none and the default is missing or of another image size.
    """
    path = folder / "camera-intrinsics.txt"
    if not path.is_file():
        if default is not None and (default.width, default.height) == size:
            return default
        known = "is known" if default is None else f"is known for {size[0]}x{size[1]} pixels"
        raise DatasetError(f"{folder}: no camera {known}; write its 3x3 matrix into {path}")
    k = read_numbers(path)
    lens_path = folder / "camera-distortion.txt"
    lens = tuple(read_numbers(lens_path).tolist()) if lens_path.is_file() else ()
    if k.size != 9:
        raise DatasetError(f"{path}: holds {k.size} numbers, expected 9 (3x3)")
    try:
        return PinholeCamera(float(k[0]), float(k[4]), float(k[2]), float(k[5]), *size, lens)
    except PoseError as exc:
        raise DatasetError(f"{path}{f', {lens_path}' if lens else ''}: {exc}") from exc


def poses_at(
    truth: Trajectory, timestamps_s: FloatArray, max_difference_s: float, source: Path
) -> tuple[npt.NDArray[np.int64], Trajectory]:
    """Frames that have a true pose near in time, and those poses with the frames' timestamps.

    Raises
    ------
    DatasetError
        If no frame has one; names the file.
    """
    asked = Trajectory(timestamps_s, np.zeros((len(timestamps_s), 3)), np.tile([1.0, 0, 0, 0], (len(timestamps_s), 1)))
    try:
        frames, poses = associate(asked, truth, max_difference_s)
    except PoseError as exc:
        raise DatasetError(f"{source}: {exc}") from exc
    found = truth[poses]
    return frames, Trajectory(timestamps_s[frames], found.positions_xyz, found.orientations_quat_wxyz)


def even_times(folder: Path, n_frames: int) -> FloatArray:
    """Times of frames that come with none, (n_frames,) seconds: ``frame-rate.txt`` (Hz) in the folder, else 30 Hz.

    Raises
    ------
    DatasetError
        If the file holds no positive number.
    """
    path = folder / "frame-rate.txt"
    return np.arange(n_frames) / (read_frame_rate(path) if path.is_file() else FRAME_RATE_HZ)


def read_frame_rate(path: Path) -> float:
    """The number of ``frame-rate.txt``, Hz.

    Raises
    ------
    DatasetError
        If the file holds anything but one positive number.
    """
    rate = read_numbers(path)
    if rate.size != 1 or not rate[0] > 0 or not np.isfinite(rate[0]):
        raise DatasetError(f"{path}: holds {rate.tolist()}, expected a positive frame rate in Hz")
    return float(rate[0])
