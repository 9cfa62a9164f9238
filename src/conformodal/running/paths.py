"""Paths through the beliefs about one recording, by the method that chose them."""

from __future__ import annotations

from collections.abc import Sequence

from conformodal.model.model import HINDSIGHT, ONLINE
from conformodal.poses import Trajectory
from conformodal.reasoning.filter import Posterior
from conformodal.reasoning.observations import Observations, PosePath
from conformodal.reasoning.places import choose_places, own_hypotheses
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.smoother import smooth

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
