"""The 7-Scenes layout (Shotton et al. 2013), which the corridor world is written in too.

A recording is a folder of ``frame-NNNNNN.color.png`` (or ``.jpg``) with ``frame-NNNNNN.pose.txt`` beside each: a
4x4 camera-to-world matrix in metres. A scene is a folder of recordings ``seq-NN``. A file
``camera-intrinsics.txt`` (3x3), in either folder, gives the camera; without one, it is that of 7-Scenes. Its lens is
free of distortion unless ``camera-distortion.txt`` beside it holds k1, k2, p1, p2 and perhaps k3, as in OpenCV. The
layout has no timestamps: a file ``frame-rate.txt`` (one number, Hz) likewise gives the rate, else it is 30 Hz.
``TrainSplit.txt`` and ``TestSplit.txt`` beside the recordings list them as ``sequence1``, one a line.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera, PoseError, Trajectory

from .errors import DatasetError
from .files import camera_beside, image_size, read_frame_rate, read_lines, read_numbers
from .sequence import Sequence

FRAME_RATE_HZ = 30.0
CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
# Recordings of one scene are laid one after the other in time, this far apart.
_GAP_BETWEEN_RECORDINGS_S = 10.0
_LISTS = ("TrainSplit.txt", "TestSplit.txt")
_LISTED = re.compile(r"seq(?:uence)?[ _-]*(\d+)", re.IGNORECASE)
_IMAGE = re.compile(r"frame-(\d+)\.color\.(png|jpg|jpeg)$")


def read_sevenscenes(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read a recording, or a scene of several, without decoding images.

    Parameters
    ----------
    folder
        A recording (``seq-01``) or a scene that holds some.
    require_poses
        False also reads frames without pose files; the sequence then has no truth.

    Raises
    ------
    DatasetError
        If the folder is missing or empty, a pose is missing, unreadable, not finite or no rigid motion, the
        intrinsics are none, or the lists do not name every recording once. Names the file.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; expected 7-Scenes frames")
    recordings = [folder] if _frames(folder) else [p for p in sorted(folder.glob("seq-*")) if p.is_dir()]
    images: list[Path] = []
    times: list[float] = []
    owner: list[int] = []
    start, rate = 0.0, _frame_rate(folder, recordings)
    for number, recording in enumerate(recordings):
        frames = _frames(recording)
        if not frames:
            raise DatasetError(f"{recording}: holds no frame-NNNNNN.color.png or .jpg")
        images += [path for _, path in frames]
        times += [start + i / rate for i, _ in frames]
        owner += [number] * len(frames)
        start = times[-1] + _GAP_BETWEEN_RECORDINGS_S
    if not images:
        raise DatasetError(f"{folder}: holds no frame-NNNNNN.color.png or .jpg, nor folders seq-NN with some")
    stamps = np.array(times)
    held_out = None if recordings == [folder] else _listed_for_testing(folder, recordings)
    return Sequence(
        name=folder.resolve().name if recordings == [folder] else f"{folder.resolve().name} ({len(recordings)} seq)",
        image_paths=tuple(images),
        timestamps_s=stamps,
        recording=np.array(owner, dtype=np.int64),
        camera=_camera(folder, images[0]),
        truth=_truth(images, stamps, required=require_poses),
        given_test=None if held_out is None else held_out[owner],
    )


def _listed_for_testing(folder: Path, recordings: list[Path]) -> npt.NDArray[np.bool_] | None:
    """Which of a scene's recordings are in its list of test recordings; None without lists."""
    lists = [folder / name for name in _LISTS]
    there = [path for path in lists if path.is_file()]
    if not there:
        return None
    if len(there) < len(lists):
        missing = next(path for path in lists if path not in there)
        raise DatasetError(f"{missing}: is missing; {there[0].name} beside it needs it")
    matches = [_LISTED.fullmatch(path.name) for path in recordings]
    numbers = {int(match[1]): i for i, match in enumerate(matches) if match}
    where: dict[int, str] = {}  # the line that names a recording
    held_out = np.zeros(len(recordings), dtype=bool)
    for path in lists:
        for at, line in enumerate(read_lines(path), start=1):
            text, place = line.strip(), f"{path.name}, line {at}"
            if not text:
                continue
            match = _LISTED.fullmatch(text)
            if match is None:
                raise DatasetError(f"{path}: line {at} is {text!r}, expected a recording such as sequence1")
            i = numbers.get(int(match[1]))
            if i is None:
                raise DatasetError(f"{path}: line {at} names {text!r}, but {folder} has no such folder seq-NN")
            if i in where:
                raise DatasetError(f"{path}: line {at} names {recordings[i].name}, which {where[i]} names too")
            where[i], held_out[i] = place, path is lists[1]
    for i, recording in enumerate(recordings):
        if i not in where:
            raise DatasetError(f"{lists[0]}: names {recording.name} in no line, nor does {lists[1].name}")
    for path, empty in zip(lists, (held_out.all(), not held_out.any()), strict=True):
        if empty:
            raise DatasetError(f"{path}: names no recording, expected one or more")
    return held_out


def _frames(folder: Path) -> list[tuple[int, Path]]:
    """Frame numbers and image paths, in order; a frame present as png and jpg counts once, as png."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = _IMAGE.search(path.name)
        if match and (int(match[1]) not in found or match[2] == "png"):
            found[int(match[1])] = path
    return sorted(found.items())


def pose_path(image: Path) -> Path:
    """The pose file that belongs to an image file."""
    return image.with_name(_IMAGE.sub(r"frame-\1.pose.txt", image.name))


def _truth(images: list[Path], stamps: npt.NDArray[np.float64], *, required: bool) -> Trajectory | None:
    missing = [path for path in images if not pose_path(path).is_file()]
    if missing and (required or len(missing) < len(images)):
        raise DatasetError(
            f"{pose_path(missing[0])}: pose is missing ({len(missing)} of {len(images)} frames have none)"
        )
    if missing:
        return None
    poses = np.stack([_read_matrix(pose_path(path), 4) for path in images])
    try:
        return Trajectory.from_poses_se3(stamps, poses)
    except PoseError:
        for path, pose in zip(images, poses, strict=True):  # find the one at fault, to name its file
            try:
                Trajectory.from_poses_se3(np.zeros(1), pose[None])
            except PoseError as exc:
                raise DatasetError(f"{pose_path(path)}: {exc}") from exc
        raise


def _read_matrix(path: Path, size: int) -> npt.NDArray[np.float64]:
    matrix = read_numbers(path)
    if matrix.size != size * size:
        raise DatasetError(f"{path}: holds {matrix.size} numbers, expected {size * size} ({size}x{size})")
    matrix = matrix.reshape(size, size)
    if not np.isfinite(matrix).all():
        raise DatasetError(f"{path}: holds NaN or infinity")
    if np.abs(matrix[-1] - np.eye(size)[-1]).max() > 1e-6:
        raise DatasetError(f"{path}: its last row is {matrix[-1].tolist()}, expected {np.eye(size)[-1].tolist()}")
    return matrix


def _beside(name: str, recording: Path, folder: Path) -> Path | None:
    """A file that may lie with the recording, with the scene, or with the recording's scene."""
    for place in (recording, folder, folder.resolve().parent):
        if (place / name).is_file():
            return place / name
    return None


def _frame_rate(folder: Path, recordings: list[Path]) -> float:
    path = _beside("frame-rate.txt", recordings[0] if recordings else folder, folder)
    if path is None:
        return FRAME_RATE_HZ
    return read_frame_rate(path)


def _camera(folder: Path, first_image: Path) -> PinholeCamera:
    path = _beside("camera-intrinsics.txt", first_image.parent, folder)
    return camera_beside(folder if path is None else path.parent, image_size(first_image), CAMERA)
