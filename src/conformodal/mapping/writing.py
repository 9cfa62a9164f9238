"""A map as a recording on disk, in COLMAP's layout as text."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory
from conformodal.io.frame_table import METRES_PER_UNIT

from .clips import Clip
from .settings import require_pycolmap
from .structure import Structure
from .world import METRES, World

IMAGES, MODEL, FRAMES, RECORD = "images", "sparse/0", "frames.csv", "map.json"
_ONLY_NEW = ("rigs.txt", "frames.txt")  # of rigs, which each of these images is alone in


def write_recording(
    folder: Path, clips: Sequence[Clip], structure: Structure, poses: Mapping[str, FloatArray], world: World
) -> None:
    """Write cameras, poses, points and times beside the images, which lie in the folder already.

    `poses` are ``T_world_cam`` (4, 4) of all registered frames, in the map; they and the points are brought to the
    world. Frames without a pose stay images that no pose is of; clips that do not connect are removed.
    """
    for clip in clips:
        if not any(image in poses for image in clip.images):
            shutil.rmtree(folder / IMAGES / clip.name)
    clips = [clip for clip in clips if (folder / IMAGES / clip.name).is_dir()]
    place = folder / MODEL
    place.mkdir(parents=True)
    model = require_pycolmap().Reconstruction(structure.model)
    model.transform(_sim3(world))
    model.write_text(place)
    for name in _ONLY_NEW:  # which older programs do not read, and newer ones do not need
        (place / name).unlink(missing_ok=True)
    first_id = 1 + max(model.images)
    others = [image for clip in clips for image in clip.images if image in poses and image not in structure.pieces[0]]
    cameras = {clip.name: _camera_id(structure, clip) for clip in clips}
    with (place / "images.txt").open("a", encoding="utf-8") as file:
        for number, name in enumerate(others, start=first_id):
            back = np.linalg.inv(world_pose(poses[name], world))
            row = Trajectory.from_poses_se3([0.0], back[None])
            numbers = [*row.orientations_quat_wxyz[0].tolist(), *row.positions_xyz[0].tolist()]
            file.write(f"{number} {' '.join(map(repr, numbers))} {cameras[name.partition('/')[0]]} {name}\n\n")
    times = [f"{time:.9f}" for clip in clips for time in clip.times_s.tolist()]
    _write_lines(folder / "times.txt", times)
    rows = [
        f'{image},"{source}",{time:.9f}'
        for clip in clips
        for image, source, time in zip(clip.images, clip.source_names, clip.times_s.tolist(), strict=True)
    ]
    _write_lines(folder / FRAMES, ["image,source,time_s", *rows])
    if world.unit == METRES:
        _write_lines(folder / METRES_PER_UNIT, ["1.0"])


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Write what is known of the map."""
    (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def world_pose(pose: FloatArray, world: World) -> FloatArray:
    """A pose ``T_world_cam`` (4, 4) of the map in the world."""
    R, t, scale = world.similarity
    there = np.eye(4)
    there[:3, :3] = R @ pose[:3, :3]
    there[:3, 3] = scale * R @ pose[:3, 3] + t
    return there


def _sim3(world: World) -> Any:
    pycolmap = require_pycolmap()
    R, t, scale = world.similarity
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(R), t)


def _camera_id(structure: Structure, clip: Clip) -> int:
    """The camera of a clip of which keyframes are in the map."""
    mapped = next(name for name in clip.keyframe_images if name in structure.pieces[0])
    return int(structure.model.find_image_with_name(mapped).camera_id)


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
