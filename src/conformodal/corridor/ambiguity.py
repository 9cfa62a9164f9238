"""Do regions hold every place that looks the same? Only a world whose ambiguity is known can tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.progress import Progress
from conformodal.geometry import Trajectory
from conformodal.localizer.candidates import pose_targets
from conformodal.localizer.regions import PoseRegions

from .render import CAMERA_NOISE_LEVELS, Renderer

# Two views are the same if all but this share of the pixels agree within three spreads of the camera's noise.
MAX_SHARE_DIFFERENT = 0.001
MAX_LEVEL_DIFFERENCE = 3 * CAMERA_NOISE_LEVELS


@dataclass(frozen=True, eq=False)
class LookAlikes:
    """Other places with the same view as a frame."""

    positions_xyz: FloatArray  # (m, 3) metres
    held: BoolArray  # (m,) whether the frame's region holds the pose there


def find_look_alikes(
    regions: PoseRegions,
    truth: Trajectory,
    sign_reference: FloatArray,
    renderer: Renderer,
    progress: Progress | None = None,
) -> list[LookAlikes]:
    """Look for every frame's look-alike places in the corridor, and check whether its region holds them."""
    every = []
    for i, pose in enumerate(truth.poses_se3):
        others = same_views(renderer, pose)
        targets = np.zeros((0, 7))
        if len(others):
            there = Trajectory.from_poses_se3(np.arange(float(len(others))), others)
            targets = pose_targets(there, sign_reference)
        held = regions[np.full(len(targets), i)].contains(targets, joint=True)
        every.append(LookAlikes(others[:, :3, 3], held))
        if progress is not None:
            progress(i + 1, len(truth))
    return every


def count_look_alikes(every: list[LookAlikes]) -> dict[str, float]:
    """For ``metrics.json``: frames with such places, all of these places, and the share that the regions hold."""
    held = np.concatenate([one.held for one in every])
    n_frames = sum(len(one.held) > 0 for one in every)
    return {"n_frames": n_frames, "n_places": len(held), "share_held": float(held.sum() / max(len(held), 1))}


def same_views(renderer: Renderer, T_world_cam: FloatArray) -> FloatArray:
    """Other poses from which the view is the same, (m, 4, 4); the pose itself is not among them.

    Without what is unique in it the building repeats itself, so the only candidates are its repetitions; each is
    rendered without noise and compared pixel by pixel.
    """
    view = renderer.render(T_world_cam).astype(np.int16)
    alike = []
    for pose in renderer.world.repetitions(T_world_cam):
        different = (np.abs(renderer.render(pose).astype(np.int16) - view) > MAX_LEVEL_DIFFERENCE).any(axis=2)
        if different.mean() <= MAX_SHARE_DIFFERENT:
            alike.append(pose)
    return np.array(alike).reshape(-1, 4, 4)
