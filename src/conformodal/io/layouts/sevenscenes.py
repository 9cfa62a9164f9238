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

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable, joined, numbered_frames, recording_folders
from conformodal.io.pose_text import matrix_faults, table_of
from conformodal.io.reading import FRAME_RATE_HZ, Note, read_frame_rate, read_lines, read_numbers, reader
from conformodal.io.recording import Recording

CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
_LISTS = ("TrainSplit.txt", "TestSplit.txt")
_LISTED = re.compile(r"seq(?:uence)?[ _-]*([0-9]{1,9})", re.IGNORECASE)
_RECORDING = re.compile(r"seq-[0-9]{1,9}")
_IMAGE = re.compile(r"frame-([0-9]{1,9})\.color\.(png|jpg|jpeg)", re.IGNORECASE)


def looks_like_scene(folder: Path) -> bool:
    """Whether there are frames in a folder, or in folders ``seq-NN`` in it."""
    return any(_IMAGE.fullmatch(path.name) for place in (folder, *_recordings(folder)) for path in place.iterdir())


def _recordings(folder: Path, notes: list[Note] | None = None) -> list[Path]:
    """Folders ``seq-NN`` in natural order; `notes` takes up others that begin like them."""
    found = recording_folders(folder, _RECORDING, "seq-NN", notes)
    numbers = [int(path.name[4:]) for path in found]
    twice = [path for k, path in enumerate(found) if numbers[k] in numbers[:k]]
    if twice:
        raise DatasetError(f"{twice[0]}: another folder has its number; expected one folder for a recording")
    return found


@reader
def read_sevenscenes(folder: Path | str, *, require_poses: bool = True) -> Recording:
    """Read a recording, or a scene of several, without decoding images.

    For an example see ``examples/stream.py``.

    Parameters
    ----------
    folder
        A recording (``seq-01``) or a scene that holds some.
    require_poses
        True leaves out frames without a sound pose file or image. False keeps them; the sequence has a truth only if
        every one has a pose.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; expected 7-Scenes frames")
    notes: list[Note] = []
    recordings = [folder] if numbered_frames(folder, _IMAGE, 6) else _recordings(folder, notes)
    frames = [numbered_frames(recording, _IMAGE, 6, notes) for recording in recordings]
    for recording, its in zip(recordings, frames, strict=True):
        if not its:
            raise DatasetError(f"{recording}: holds no frame-NNNNNN.color.png or .jpg")
    rate = _beside("frame-rate.txt", recordings[0] if recordings else folder, folder)
    images, times, recording_of = joined(frames, FRAME_RATE_HZ if rate is None else read_frame_rate(rate))
    if not images:
        raise DatasetError(f"{folder}: holds no frame-NNNNNN.color.png or .jpg, nor folders seq-NN with some")
    held_out = None if recordings == [folder] else _listed_for_testing(folder, recordings)
    name = folder.resolve().name if recordings == [folder] else f"{folder.resolve().name} ({len(recordings)} seq)"
    why: Damaged = {}
    posed = require_poses or any(pose_path(path).exists() for path in images)
    poses = _poses(images, why) if posed else None
    table = FrameTable(name, images, times, recording_of, poses, why, notes)
    intrinsics = _beside("camera-intrinsics.txt", images[0].parent, folder)
    camera = camera_beside(folder if intrinsics is None else intrinsics.parent, common_size(images), CAMERA, notes)
    return table.sequence(
        camera, require_poses=require_poses, given_test=None if held_out is None else held_out[recording_of]
    )


def _listed_for_testing(folder: Path, recordings: list[Path]) -> BoolArray | None:
    """Which of a scene's recordings are in its list of test recordings; None without lists."""
    lists = [folder / name for name in _LISTS]
    there = [path for path in lists if path.is_file()]
    if not there:
        return None
    if len(there) < len(lists):
        missing = next(path for path in lists if path not in there)
        raise DatasetError(f"{missing}: is missing; {there[0].name} beside it needs it")
    numbers = {int(match[1]): i for i, path in enumerate(recordings) if (match := _LISTED.fullmatch(path.name))}
    where: dict[int, str] = {}  # the line that names a recording
    held_out = np.zeros(len(recordings), dtype=bool)
    for path in lists:
        for at, text in enumerate(map(str.strip, read_lines(path)), start=1):
            if not text:
                continue
            match = _LISTED.fullmatch(text)
            if match is None:
                raise DatasetError(f"{path}: line {at} is {text!r}, expected a recording such as sequence1")
            i = numbers.get(int(match[1]), -1)
            if i < 0 or i in where:
                named = (
                    f"{text!r}, but {folder} has no such folder seq-NN"
                    if i < 0
                    else f"{recordings[i].name}, which {where[i]} names too"
                )
                raise DatasetError(f"{path}: line {at} names {named}")
            where[i], held_out[i] = f"{path.name}, line {at}", path is lists[1]
    for i, recording in enumerate(recordings):
        if i not in where:
            raise DatasetError(f"{lists[0]}: names {recording.name} in no line, nor does {lists[1].name}")
    for path, empty in zip(lists, (held_out.all(), not held_out.any()), strict=True):
        if empty:
            raise DatasetError(f"{path}: names no recording, expected one or more")
    return held_out


def pose_path(image: Path) -> Path:
    """The pose file that belongs to an image file."""
    return image.with_name(_IMAGE.sub(r"frame-\1.pose.txt", image.name))


def _poses(images: list[Path], why: Damaged) -> FloatArray:
    """Poses (n, 7) of frames, NaN where there is none, and why."""
    poses = np.full((len(images), 4, 4), np.nan)
    for i, path in enumerate(pose_path(image) for image in images):
        try:
            if path.exists():
                poses[i] = _read_matrix(path)
            else:
                why[i] = f"{path}: pose is missing"
        except DatasetError as exc:
            why[i] = str(exc)
    for i, fault in matrix_faults(poses).items():
        why[i] = f"{pose_path(images[i])}: {fault}"
    poses[list(why)] = np.nan
    return table_of(poses)


def _read_matrix(path: Path) -> FloatArray:
    matrix = read_numbers(path)
    if matrix.size != 16:
        raise DatasetError(f"{path}: holds {matrix.size} numbers, expected 16 (4x4)")
    if not np.isfinite(matrix).all():
        raise DatasetError(f"{path}: holds NaN or infinity")
    return matrix.reshape(4, 4)


def _beside(name: str, recording: Path, folder: Path) -> Path | None:
    """A file that may lie with the recording, with the scene, or with the recording's scene."""
    places = (place / name for place in (recording, folder, folder.resolve().parent))
    return next((path for path in places if path.is_file()), None)
