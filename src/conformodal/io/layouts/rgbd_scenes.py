"""RGB-D Scenes v2 (Lai, Bo and Fox 2014), the paper's data set: ``imgs/scene_NN`` and ``pc/NN.pose``.

A line of a pose file is ``qw qx qy qz x y z``, camera to world, one a frame.
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
from conformodal.io.frame_table import Damaged, FrameTable, joined, numbered_frames, recording_folders
from conformodal.io.pose_text import drop_faults, number, pose_faults, read_rows
from conformodal.io.reading import FRAME_RATE_HZ, Note, reader
from conformodal.io.recording import Recording

CAMERA = PinholeCamera(570.3, 570.3, 320.0, 240.0, 640, 480)
_IMAGE = re.compile(r"([0-9]{1,9})-color\.(png)", re.IGNORECASE)
_SCENE = re.compile(r"scene_[0-9]{1,9}")


def looks_like_scenes(folder: Path) -> bool:
    """Whether a folder holds scenes, or the images of one."""
    return (folder / "imgs").is_dir() or any(_IMAGE.fullmatch(path.name) for path in folder.iterdir())


@reader
def read_rgbd_scenes(folder: Path | str, *, require_poses: bool = True) -> Recording:
    """Read a scene, or all scenes, without decoding images.

    Parameters
    ----------
    folder
        ``.../imgs/scene_NN``, or the folder that holds ``imgs`` and ``pc``; every scene is a recording.
    require_poses
        True leaves out frames without a pose, and scenes without a pose file. False keeps them; the sequence has a
        truth only if every frame has a pose.
    """
    folder = Path(folder).resolve()
    notes: list[Note] = []
    scenes = (
        [folder] if _SCENE.fullmatch(folder.name) else recording_folders(folder / "imgs", _SCENE, "scene_NN", notes)
    )
    if not scenes:
        raise DatasetError(f"{folder}: holds no imgs/scene_NN; expected RGB-D Scenes v2")
    recordings = [numbered_frames(scene, _IMAGE, 5, notes) for scene in scenes]
    images, times, recording = joined(recordings, FRAME_RATE_HZ)
    poses: list[FloatArray] = []
    why: Damaged = {}
    first = missing = 0
    for scene, frames in zip(scenes, recordings, strict=True):
        if not frames:
            raise DatasetError(f"{scene}: holds no FFFFF-color.png")
        path = scene.parent.parent / "pc" / f"{scene.name.removeprefix('scene_')}.pose"
        if path.is_file():
            poses.append(_poses(path, [number for number, _ in frames], why, first))
        else:
            missing += 1
            poses.append(np.full((len(frames), 7), np.nan))
            why |= {first + i: f"{path}: poses are missing" for i in range(len(frames))}
        first += len(frames)
    if missing == len(scenes) and require_poses:
        raise DatasetError(why[0])
    name = folder.name if scenes == [folder] else f"{folder.name} ({len(scenes)} scenes)"
    known = np.concatenate(poses) if missing < len(scenes) else None
    table = FrameTable(name, images, times, recording, known, why, notes)
    return table.sequence(camera_beside(folder, common_size(images), CAMERA, notes), require_poses=require_poses)


def _poses(path: Path, frames: list[int], why: Damaged, first: int) -> FloatArray:
    """Rows ``x y z qw qx qy qz`` (n, 7) of the frames, the first of which is `first` of all; its number is its line."""
    faults: Damaged = {}
    rows = read_rows(
        path, lambda line: [number(x) for x in line.split()], 7, "'qw qx qy qz x y z'", faults, by_line=True
    )
    rows = rows[:, [4, 5, 6, 0, 1, 2, 3]]
    drop_faults(rows, pose_faults(rows[:, :3], rows[:, 3:]), path, faults)
    if frames[-1] >= len(rows):
        raise DatasetError(f"{path}: holds {len(rows)} poses, but there is an image {frames[-1]} (counted from 0)")
    why |= {first + i: faults[line] for i, line in enumerate(frames) if line in faults}
    return rows[frames]
