"""Do regions hold every place that looks the same? Only a world whose ambiguity is known can tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.progress import Progress
from conformodal.geometry import Trajectory
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.targets import pose_targets

from .render import Renderer, same_views


@dataclass(eq=False)
class AmbiguityCheck:
    """Other places with the same view, and whether the regions hold them."""

    places: list[FloatArray] = field(default_factory=list)  # one (m, 3) array per frame: positions in metres
    held: list[BoolArray] = field(default_factory=list)  # one (m,) array per frame: whether the region holds the pose

    def record(self) -> dict[str, Any]:
        """For ``metrics.json``: frames with such places, all of these places, and the share that the regions hold."""
        n_places, n_held = sum(map(len, self.places)), sum(int(held.sum()) for held in self.held)
        n_frames = sum(len(places) > 0 for places in self.places)
        return {"n_frames": n_frames, "n_places": n_places, "share_held": n_held / max(n_places, 1)}


def check_ambiguity(
    regions: PoseRegions,
    truth: Trajectory,
    sign_reference: FloatArray,
    renderer: Renderer,
    progress: Progress | None = None,
) -> AmbiguityCheck:
    """Look for every frame's look-alike places in the corridor, and check whether the regions hold them."""
    check = AmbiguityCheck()
    for i, pose in enumerate(truth.poses_se3):
        others = same_views(renderer, pose)
        targets = np.zeros((0, 7))
        if len(others):
            there = Trajectory.from_poses_se3(np.arange(float(len(others))), others)
            targets = pose_targets(there, sign_reference)
        check.places.append(others[:, :3, 3])
        check.held.append(regions[np.full(len(targets), i)].contains(targets, joint=True))
        if progress is not None:
            progress(i + 1, len(truth))
    return check
