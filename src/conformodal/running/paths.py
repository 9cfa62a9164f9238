"""Paths through the beliefs about one recording, by the method that chose them."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.poses import Trajectory
from conformodal.reasoning.observations import Observations, PosePath
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.smoother import smooth
from conformodal.reasoning.viterbi import viterbi

# The poses that a robot gets, each when its frame comes and from the frames so far; all others see later frames too.
ONLINE = "online"
# The first is the answer of a run.
METHODS = ("smoothed", "viterbi", ONLINE)
PAPERS_METHOD = "greedy"


def whole_paths(seen: Observations, prior: MotionPrior) -> dict[str, Trajectory]:
    """The paths that need all frames of a recording: the most probable one, and that one smoothed."""
    best = viterbi(seen, prior)
    return {"smoothed": as_trajectory(smooth(best, seen, prior)), "viterbi": as_trajectory(best)}


def rows_by_recording(recording: IntArray) -> list[IntArray]:
    """Rows of each recording, from the numbers (n,) of the recordings: motion is never linked across recordings."""
    return [np.flatnonzero(recording == number) for number in np.unique(recording)]


def as_trajectory(path: PosePath) -> Trajectory:
    """The poses of a path."""
    return Trajectory(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)
