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

from conformodal.core.arrays import BoolArray
from conformodal.geometry import PinholeCamera
from conformodal.geometry.poses import table_of
from conformodal.io.cameras import INTRINSICS, camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import matrix_faults
from conformodal.io.reading import numbered_frames, parse_lines, read_frame_rate, read_numbers, recording_folders

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
    alone = bool(numbered_frames(folder, _IMAGE))
    recordings = [folder] if alone else recording_folders(folder, _PREFIX)
    frames = [numbered_frames(recording, _IMAGE) for recording in recordings]
    empty = [recording for recording, images in zip(recordings, frames, strict=True) if not images]
    if empty or not recordings:
        raise DatasetError(f"{(*empty, folder)[0]}: holds no frame-NNNNNN.color.png or .jpg")
    rate_hz = read_frame_rate(_beside("frame-rate.txt", recordings[0], folder))
    name = folder.name if alone else f"{folder.name} ({len(recordings)} seq)"
    table = FrameTable.of_recordings(name, frames, rate_hz)
    table.source = pose_path(table.images[0])
    intrinsics = _beside(INTRINSICS, recordings[0], folder) or folder / INTRINSICS
    table.camera = camera_beside(intrinsics.parent, common_size(table.images), CAMERA, table.notes)
    if not alone and any((folder / name).is_file() for name in _LISTS):
        table.given_test = _listed_for_testing(folder, recordings)[table.recording]
    if any(pose_path(image).exists() for image in table.images):
        table.source = folder
        _add_poses(table)
    return table


def _listed_for_testing(folder: Path, recordings: list[Path]) -> BoolArray:
    """Which of a scene's recordings are in its list of test recordings; each must be in one of the two lists."""

    def parse(line: str) -> int:
        match = _LISTED.fullmatch(line.strip())
        if match is None:
            raise ValueError("not a recording")
        return int(match[1])

    train, test = (parse_lines(folder / name, parse, "'sequence1'") for name in _LISTS)
    numbers = [int(recording.name.removeprefix(_PREFIX)) for recording in recordings]
    if sorted(train + test) != sorted(numbers):
        named = f"{_LISTS[0]} names {train} and {_LISTS[1]} {test}"
        raise DatasetError(f"{folder}: {named}, expected each of the folders {numbers} once")
    return np.isin(numbers, test)


def pose_path(image: Path) -> Path:
    """The pose file that belongs to an image file."""
    return image.with_name(_IMAGE.sub(r"frame-\1.pose.txt", image.name))


def _add_poses(table: FrameTable) -> None:
    poses = np.full((len(table.images), 4, 4), np.nan)
    for i, path in enumerate(map(pose_path, table.images)):
        table.why[i] = f"{path}: pose is missing, or holds NaN or infinity"
        if path.exists():
            numbers = read_numbers(path)
            if numbers.size != 16:
                raise DatasetError(f"{path}: holds {numbers.size} numbers, expected 16 (4x4)")
            poses[i] = numbers.reshape(4, 4)
    faults = matrix_faults(poses)
    table.why |= {i: f"{pose_path(table.images[i])}: {fault}" for i, fault in faults.items()}
    poses[list(faults)] = np.nan
    table.poses = table_of(poses)


def _beside(name: str, recording: Path, folder: Path) -> Path | None:
    """A file that may lie with the recording, with the scene, or with the recording's scene."""
    places = (place / name for place in (recording, folder, folder.parent))
    return next((path for path in places if path.is_file()), None)
