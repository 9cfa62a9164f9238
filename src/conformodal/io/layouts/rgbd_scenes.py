"""RGB-D Scenes v2 (Lai, Bo and Fox 2014), the paper's data set: ``imgs/scene_NN`` and ``pc/NN.pose``.

A line of a pose file is ``qw qx qy qz x y z``, camera to world, one per frame.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.diagnosis.columns import length_doubt
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import DOUBTFUL, FrameTable
from conformodal.io.pose_files import PoseRows, pose_faults
from conformodal.io.reading import FRAME_RATE_HZ, Note, numbered_frames, numbers_in, parse_lines, recording_folders

CAMERA = PinholeCamera(570.3, 570.3, 320.0, 240.0, 640, 480)
_IMAGE = re.compile(r"([0-9]{1,9})-color\.png", re.IGNORECASE)
_PREFIX = "scene_"


def looks_like_scenes(folder: Path) -> bool:
    """Whether a folder holds scenes, or the images of one."""
    return (folder / "imgs").is_dir() or any(_IMAGE.fullmatch(path.name) for path in folder.iterdir())


def read_rgbd_scenes(folder: Path) -> FrameTable:
    """Read ``.../imgs/scene_NN``, or the folder that holds ``imgs`` and ``pc``; every scene is a recording."""
    one = folder.name.startswith(_PREFIX)
    scenes = [folder] if one else recording_folders(folder / "imgs", _PREFIX)
    recordings = [numbered_frames(scene, _IMAGE) for scene in scenes]
    if not scenes or not all(recordings):
        raise DatasetError(f"{folder}: holds no imgs/scene_NN, or one without FFFFF-color.png")
    name = folder.name if one else f"{folder.name} ({len(scenes)} scenes)"
    table = FrameTable.of_recordings(name, recordings, FRAME_RATE_HZ)
    table.camera = camera_beside(folder, common_size(table.images), CAMERA, table.notes)
    files = [scene.parent.parent / "pc" / f"{scene.name.removeprefix(_PREFIX)}.pose" for scene in scenes]
    poses, table.source = np.full((len(table.images), 7), np.nan), files[0]
    for k, path in enumerate(files):
        rows = np.flatnonzero(table.recording == k)
        table.why |= dict.fromkeys(rows.tolist(), f"{path}: poses are missing")
        if path.is_file():
            read, lines = _poses(path, table.notes), [number for number, _ in recordings[k]]
            if lines[-1] >= len(read.rows):
                there = f"but there is an image {lines[-1]} (counted from 0)"
                raise DatasetError(f"{path}: holds {len(read.rows)} poses, {there}")
            poses[rows], table.poses = read.rows[lines], poses
            table.why |= {i: read.faults.get(line, "") for i, line in zip(rows.tolist(), lines, strict=True)}
    return table


def _poses(path: Path, notes: list[Note]) -> PoseRows:
    lines = parse_lines(path, partial(numbers_in, count=7), "'qw qx qy qz x y z'", by_line=True)
    rows = np.array(lines)[:, [4, 5, 6, 0, 1, 2, 3]]
    if doubt := length_doubt(path, rows, 3):
        notes.append(Note(DOUBTFUL, doubt))
    table = PoseRows(path, rows)
    table.drop(pose_faults(rows[:, :3], rows[:, 3:]))
    return table
