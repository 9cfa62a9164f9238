"""RGB-D Scenes v2 (Lai, Bo and Fox 2014), the paper's data set: ``imgs/scene_NN`` and ``pc/NN.pose``.

A line of a pose file is ``qw qx qy qz x y z``, camera to world, one a frame.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.poses import PinholeCamera, TrajectoryFileError
from conformodal.poses.text import drop_faults, number, pose_faults, read_rows

from .cameras import camera_beside
from .decoding import common_size, natural_key
from .draft import Damaged, FrameTable
from .errors import DatasetError
from .reading import Note, reader
from .sequence import Sequence

CAMERA = PinholeCamera(570.3, 570.3, 320.0, 240.0, 640, 480)
FRAME_RATE_HZ = 30.0
_GAP_BETWEEN_SCENES_S = 10.0
_IMAGE = re.compile(r"([0-9]{1,9})-color\.png", re.IGNORECASE)
_SCENE = re.compile(r"scene_[0-9]{1,9}")


def looks_like_scenes(folder: Path) -> bool:
    """Whether a folder holds scenes, or the images of one."""
    return (folder / "imgs").is_dir() or any(_IMAGE.fullmatch(path.name) for path in folder.iterdir())


@reader
def read_rgbd_scenes(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read a scene, or all scenes, without decoding images.

    Parameters
    ----------
    folder
        ``.../imgs/scene_NN``, or the folder that holds ``imgs`` and ``pc``; every scene is a recording.
    require_poses
        True leaves out frames without a pose, and scenes without a pose file. False keeps them; the sequence has a
        truth only if every frame has a pose.

    Raises
    ------
    DatasetError
        If something is missing or damaged, or there are more images than poses. Names the file.
    """
    folder = Path(folder).resolve()
    notes: list[Note] = []
    scenes = [folder] if _SCENE.fullmatch(folder.name) else _scenes(folder, notes)
    if not scenes:
        raise DatasetError(f"{folder}: holds no imgs/scene_NN; expected RGB-D Scenes v2")
    images: list[Path] = []
    times: list[float] = []
    owner: list[int] = []
    poses: list[npt.NDArray[np.float64]] = []
    why: Damaged = {}
    start, missing = 0.0, 0
    for k, scene in enumerate(scenes):
        frames = _frames(scene, notes)
        if not frames:
            raise DatasetError(f"{scene}: holds no FFFFF-color.png")
        order = sorted(frames)
        path = scene.parent.parent / "pc" / f"{scene.name.removeprefix('scene_')}.pose"
        if path.is_file():
            poses.append(_poses(path, order, why, len(images)))
        else:
            missing += 1
            poses.append(np.full((len(order), 7), np.nan))
            why |= {len(images) + i: f"{path}: poses are missing" for i in range(len(order))}
        images += [frames[i] for i in order]
        times += [start + i / FRAME_RATE_HZ for i in order]
        owner += [k] * len(order)
        start = times[-1] + _GAP_BETWEEN_SCENES_S
    if missing == len(scenes) and require_poses:
        raise DatasetError(why[0])
    name = folder.name if scenes == [folder] else f"{folder.name} ({len(scenes)} scenes)"
    known = np.concatenate(poses) if missing < len(scenes) else None
    draft = FrameTable(name, images, np.array(times), np.array(owner, dtype=np.int64), known, why, notes)
    return draft.sequence(camera_beside(folder, common_size(images), CAMERA, notes), require_poses=require_poses)


def _scenes(folder: Path, notes: list[Note]) -> list[Path]:
    found = []
    for path in sorted((folder / "imgs").glob("scene_*"), key=lambda p: natural_key(p.name)):
        if path.is_dir() and _SCENE.fullmatch(path.name):
            found.append(path)
        elif path.is_dir():
            notes.append(Note("left out, no scene", f"{path}: is not called scene_NN"))
    return found


def _frames(scene: Path, notes: list[Note]) -> dict[int, Path]:
    found: dict[int, Path] = {}
    matches = [m for p in scene.iterdir() if (m := _IMAGE.fullmatch(p.name))]
    for match in sorted(matches, key=lambda m: (len(m[1]) != 5, m[0])):
        path = scene / match[0]
        first = found.setdefault(int(match[1]), path)
        if first is not path:
            notes.append(Note("left out, another file has its number", f"{path}: {first.name} has its number"))
    return found


def _poses(path: Path, frames: list[int], why: Damaged, first: int) -> npt.NDArray[np.float64]:
    """Rows ``x y z qw qx qy qz`` (n, 7) of the frames, the first of which is `first` of all; its number is its line."""
    faults: Damaged = {}
    try:
        rows = read_rows(
            path, lambda line: [number(x) for x in line.split()], 7, "'qw qx qy qz x y z'", faults, by_line=True
        )
        rows = rows[:, [4, 5, 6, 0, 1, 2, 3]]
        drop_faults(rows, pose_faults(rows[:, :3], rows[:, 3:]), path, faults)
    except TrajectoryFileError as exc:
        raise DatasetError(str(exc)) from exc
    if frames[-1] >= len(rows):
        raise DatasetError(f"{path}: holds {len(rows)} poses, but there is an image {frames[-1]} (counted from 0)")
    why |= {first + i: faults[line] for i, line in enumerate(frames) if line in faults}
    return rows[frames]
