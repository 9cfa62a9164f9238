"""Do regions hold every place that looks the same? Only a world whose ambiguity is known can tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.progress import Progress
from conformodal.geometry import Trajectory, pose_targets
from conformodal.localizer.regions import PoseRegions

from .render import CAMERA_NOISE_LEVELS, Renderer

# Two views are the same if all but this share of the pixels agree within three spreads of the camera's noise.
MAX_SHARE_DIFFERENT = 0.001
MAX_LEVEL_DIFFERENCE = 3 * CAMERA_NOISE_LEVELS


def count_look_alikes(
    regions: PoseRegions,
    truth: Trajectory,
    sign_reference: FloatArray,
    renderer: Renderer,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """For ``metrics.json``: frames with look-alike places, all of these places, and the share that the regions hold."""
    n_frames, held = 0, list[bool]()
    for i, pose in enumerate(truth.poses_se3):
        if len(others := same_views(renderer, pose)):
            there = Trajectory.from_poses_se3(np.arange(float(len(others))), others)
            targets = pose_targets(there, sign_reference)
            held += regions[np.full(len(targets), i)].contains(targets, joint=True).tolist()
            n_frames += 1
        if progress is not None:
            progress(i + 1, len(truth))
    return {"n_frames": n_frames, "n_places": len(held), "share_held": sum(held) / max(len(held), 1)}


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
