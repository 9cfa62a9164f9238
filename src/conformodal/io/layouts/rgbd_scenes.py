"""RGB-D Scenes v2 (Lai, Bo and Fox 2014), the paper's data set: ``imgs/scene_NN`` and ``pc/NN.pose``.

A line of a pose file is ``qw qx qy qz x y z``, camera to world, one per frame.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import DOUBTFUL, Damaged, FrameTable
from conformodal.io.pose_files import length_doubt, pose_faults, read_rows
from conformodal.io.reading import (
    FRAME_RATE_HZ,
    Note,
    joined_recordings,
    numbered_frames,
    numbers_in,
    recording_folders,
)

CAMERA = PinholeCamera(570.3, 570.3, 320.0, 240.0, 640, 480)
_IMAGE = re.compile(r"([0-9]{1,9})-color\.png", re.IGNORECASE)
_PREFIX = "scene_"


def looks_like_scenes(folder: Path) -> bool:
    """Whether a folder holds scenes, or the images of one."""
    return (folder / "imgs").is_dir() or any(_IMAGE.fullmatch(path.name) for path in folder.iterdir())


def read_rgbd_scenes(folder: Path) -> FrameTable:
    """Read ``.../imgs/scene_NN``, or the folder that holds ``imgs`` and ``pc``; every scene is a recording."""
    notes: list[Note] = []
    one = folder.name.startswith(_PREFIX)
    scenes = [folder] if one else recording_folders(folder / "imgs", _PREFIX, notes)
    if not scenes:
        raise DatasetError(f"{folder}: holds no imgs/scene_NN; expected RGB-D Scenes v2")
    recordings = [numbered_frames(scene, _IMAGE) for scene in scenes]
    images, times, recording = joined_recordings(recordings, FRAME_RATE_HZ)
    poses = np.full((len(images), 7), np.nan)
    why: Damaged = {}
    files = [scene.parent.parent / "pc" / f"{scene.name.removeprefix(_PREFIX)}.pose" for scene in scenes]
    first = 0
    for scene, frames, path in zip(scenes, recordings, files, strict=True):
        if not frames:
            raise DatasetError(f"{scene}: holds no FFFFF-color.png")
        of_scene = range(first, first + len(frames))
        if path.is_file():
            poses[of_scene] = _poses(path, [number for number, _ in frames], why, first, notes)
        else:
            why |= dict.fromkeys(of_scene, f"{path}: poses are missing")
        first += len(frames)
    name = folder.name if one else f"{folder.name} ({len(scenes)} scenes)"
    camera = camera_beside(folder, common_size(images), CAMERA, notes)
    posed = poses if any(path.is_file() for path in files) else None
    return FrameTable(name, images, times, camera, posed, recording, why=why, notes=notes, source=files[0])


def _poses(path: Path, frames: list[int], why: Damaged, first: int, notes: list[Note]) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of the frames, the first of which is `first` of all; its number is its line."""
    table = read_rows(path, numbers_in, 7, "'qw qx qy qz x y z'", by_line=True)
    if doubt := length_doubt(path, table.rows, 0):
        notes.append(Note(DOUBTFUL, doubt))
    rows = table.rows = table.rows[:, [4, 5, 6, 0, 1, 2, 3]]
    table.drop(pose_faults(rows[:, :3], rows[:, 3:]))
    if frames[-1] >= len(rows):
        raise DatasetError(f"{path}: holds {len(rows)} poses, but there is an image {frames[-1]} (counted from 0)")
    why |= {first + i: table.damaged[line] for i, line in enumerate(frames) if line in table.damaged}
    return rows[frames]
