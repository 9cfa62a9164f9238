"""The 7-Scenes layout (Shotton et al. 2013), which the corridor world is written in too.

A recording is a folder of ``frame-NNNNNN.color.png`` (or ``.jpg``) with ``frame-NNNNNN.pose.txt`` beside each: a
4x4 camera-to-world matrix in metres. A scene is a folder of recordings ``seq-NN``. A file
``camera-intrinsics.txt`` (3x3), in either folder, gives the camera; without one, it is that of 7-Scenes. Its lens is
free of distortion unless ``camera-distortion.txt`` beside it holds k1, k2, p1, p2 and perhaps k3, as in OpenCV. The
layout has no timestamps: a file ``frame-rate.txt`` (one number, Hz) likewise gives the rate, else it is 30 Hz.
``TrainSplit.txt`` and ``TestSplit.txt`` beside the recordings list them as ``sequence1``, one per line.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import INTRINSICS, camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable
from conformodal.io.pose_files import matrix_faults, table_of
from conformodal.io.reading import (
    FRAME_RATE_HZ,
    Note,
    joined_recordings,
    numbered_frames,
    read_frame_rate,
    read_lines,
    read_numbers,
    recording_folders,
)

CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
_LISTS = ("TrainSplit.txt", "TestSplit.txt")
_LISTED = re.compile(r"sequence\s*([0-9]{1,9})", re.IGNORECASE)
_PREFIX = "seq-"
_IMAGE = re.compile(r"frame-([0-9]{1,9})\.color\.(?:png|jpg|jpeg)", re.IGNORECASE)


def looks_like_scene(folder: Path) -> bool:
    """Whether there are frames in a folder, or in folders ``seq-NN`` in it."""
    places = (folder, *folder.glob(f"{_PREFIX}*/"))
    return any(_IMAGE.fullmatch(path.name) for place in places if place.is_dir() for path in place.iterdir())


def read_sevenscenes(folder: Path) -> FrameTable:
    """Read a recording (``seq-01``), or a scene that holds some."""
    notes: list[Note] = []
    recordings = [folder] if numbered_frames(folder, _IMAGE) else recording_folders(folder, _PREFIX, notes)
    frames = [numbered_frames(recording, _IMAGE) for recording in recordings]
    empty = [recording for recording, images in zip(recordings, frames, strict=True) if not images]
    if empty or not recordings:
        raise DatasetError(f"{(*empty, folder)[0]}: holds no frame-NNNNNN.color.png or .jpg")
    rate = _beside("frame-rate.txt", recordings[0], folder)
    images, times, recording_of = joined_recordings(frames, FRAME_RATE_HZ if rate is None else read_frame_rate(rate))
    held_out = None if recordings == [folder] else _listed_for_testing(folder, recordings)
    name = folder.name if recordings == [folder] else f"{folder.name} ({len(recordings)} seq)"
    why: Damaged = {}
    poses = _poses(images, why) if any(pose_path(path).exists() for path in images) else None
    intrinsics = _beside(INTRINSICS, recordings[0], folder)
    camera = camera_beside(folder if intrinsics is None else intrinsics.parent, common_size(images), CAMERA, notes)
    tests = None if held_out is None else held_out[recording_of]
    source = pose_path(images[0]) if poses is None else folder
    return FrameTable(name, images, times, camera, poses, recording_of, tests, why, notes, source=source)


def _listed_for_testing(folder: Path, recordings: list[Path]) -> BoolArray | None:
    """Which of a scene's recordings are in its list of test recordings; None without lists."""
    lists = [folder / name for name in _LISTS]
    missing = [path for path in lists if not path.is_file()]
    if len(missing) == len(lists):
        return None
    if missing:
        raise DatasetError(f"{missing[0]}: is missing, and the other list is beside it")
    places = {int(path.name.removeprefix(_PREFIX)): i for i, path in enumerate(recordings)}
    listed: dict[int, bool] = {}  # whether a recording tests
    for path in lists:
        for at, text in enumerate(map(str.strip, read_lines(path)), start=1):
            match = _LISTED.fullmatch(text)
            i = -1 if match is None else places.get(int(match[1]), -1)
            if text and (i < 0 or i in listed):
                why = "is listed before" if i >= 0 else f"does not stand for a folder in {folder}"
                raise DatasetError(f"{path}: line {at}, {text[:80]!r}, {why}")
            listed |= {i: path is lists[1]} if text else {}
        if (path is lists[1]) not in listed.values():
            raise DatasetError(f"{path}: names no recording, expected one or more")
    if unlisted := [path.name for i, path in enumerate(recordings) if i not in listed]:
        raise DatasetError(f"{lists[0]}: names {unlisted[0]} in no line, nor does {lists[1].name}")
    return np.array([listed[i] for i in range(len(recordings))])


def pose_path(image: Path) -> Path:
    """The pose file that belongs to an image file."""
    return image.with_name(_IMAGE.sub(r"frame-\1.pose.txt", image.name))


def _poses(images: list[Path], why: Damaged) -> FloatArray:
    """Poses (n, 7) of frames, NaN where there is none, and why."""
    poses = np.full((len(images), 4, 4), np.nan)
    for i, path in enumerate(map(pose_path, images)):
        try:
            if path.exists():
                poses[i] = _read_matrix(path)
            else:
                why[i] = f"{path}: pose is missing"
        except DatasetError as exc:
            why[i] = str(exc)
    why |= {i: f"{pose_path(images[i])}: {fault}" for i, fault in matrix_faults(poses).items()}
    poses[list(why)] = np.nan
    return table_of(poses)


def _read_matrix(path: Path) -> FloatArray:
    matrix = read_numbers(path)
    if matrix.size != 16 or not np.isfinite(matrix).all():
        raise DatasetError(f"{path}: holds {matrix.size} numbers, expected 16 (4x4), all finite")
    return matrix.reshape(4, 4)


def _beside(name: str, recording: Path, folder: Path) -> Path | None:
    """A file that may lie with the recording, with the scene, or with the recording's scene."""
    places = (place / name for place in (recording, folder, folder.parent))
    return next((path for path in places if path.is_file()), None)
