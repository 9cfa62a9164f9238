"""Do regions hold every place that looks the same? Only a world whose ambiguity is known can tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.datasets.corridor.render import Renderer, same_views
from conformodal.localization.targets import pose_targets
from conformodal.model.model import PoseModel
from conformodal.poses import Trajectory
from conformodal.running.estimates import OdometryRun


@dataclass(frozen=True, eq=False)
class AmbiguityCheck:
    """Other places with the same view, and whether the regions hold them.

    Attributes
    ----------
    places
        One (m, 3) array a frame: positions in metres of the other places with the same view.
    held
        One (m,) array a frame: whether the region holds the whole pose there.
    held_position
        Likewise, position alone.
    """

    places: list[npt.NDArray[np.float64]]
    held: list[npt.NDArray[np.bool_]]
    held_position: list[npt.NDArray[np.bool_]]

    @property
    def n_places(self) -> int:
        """Number of look-alike places, all frames together."""
        return sum(len(p) for p in self.places)

    @property
    def share_held(self) -> float:
        """Share of the look-alike places whose whole pose the regions hold; NaN if there are none."""
        return float(np.concatenate(self.held).mean()) if self.n_places else float("nan")

    @property
    def share_held_position(self) -> float:
        """Share of the look-alike places whose position the regions hold."""
        return float(np.concatenate(self.held_position).mean()) if self.n_places else float("nan")

    @property
    def n_frames(self) -> int:
        """Number of frames with look-alike places."""
        return sum(len(p) > 0 for p in self.places)


def check_ambiguity(
    run: OdometryRun,
    truth: Trajectory,
    model: PoseModel,
    renderer: Renderer,
    progress: Callable[[int, int], None] | None = None,
) -> AmbiguityCheck:
    """Find every frame's look-alike places in the corridor, and check whether the regions hold them."""
    places: list[npt.NDArray[np.float64]] = []
    held: list[npt.NDArray[np.bool_]] = []
    held_position: list[npt.NDArray[np.bool_]] = []
    for i, pose in enumerate(truth.poses_se3):
        others = same_views(renderer, pose)
        inside = np.zeros((0, 7), dtype=np.bool_)
        if len(others):
            there = Trajectory.from_poses_se3(np.arange(float(len(others))), others)
            inside = run.regions[np.full(len(others), i)].contains(pose_targets(there, model.sign_reference))
        places.append(others[:, :3, 3])
        held.append(np.asarray(inside.all(axis=1)))
        held_position.append(np.asarray(inside[:, :3].all(axis=1)))
        if progress is not None:
            progress(i + 1, len(truth))
    return AmbiguityCheck(places, held, held_position)
