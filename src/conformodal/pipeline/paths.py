"""Paths through the beliefs about one recording, by the method that chose them."""

from __future__ import annotations

from collections.abc import Sequence

from conformodal.geometry import Trajectory
from conformodal.localizer.filter import Posterior
from conformodal.localizer.observations import Observations, PosePath
from conformodal.localizer.places import choose_places, own_hypotheses
from conformodal.localizer.prior import MotionPrior
from conformodal.localizer.smoother import smooth

from .model import HINDSIGHT, ONLINE

# The first is the answer of a run.
METHODS = ("smoothed", HINDSIGHT, ONLINE)
PAPERS_METHOD = "greedy"


def whole_paths(posteriors: Sequence[Posterior], seen: Observations, prior: MotionPrior) -> dict[str, Trajectory]:
    """The paths that need all frames of a recording: the most probable place of each frame, and that path smoothed.

    From posteriors in hindsight, and what they were worked out from.
    """
    best, _ = choose_places(posteriors, seen.timestamps_s, prior)
    smoothed = smooth(own_hypotheses(best, seen, prior), seen, prior)
    return {"smoothed": as_trajectory(smoothed), HINDSIGHT: as_trajectory(best)}


def as_trajectory(path: PosePath) -> Trajectory:
    """The poses of a path."""
    return Trajectory(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)
