"""Paths through the beliefs about one recording, by the method that chose them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.poses import Trajectory
from conformodal.reasoning.filter import Posterior, hindsight_posteriors
from conformodal.reasoning.observations import Observations, PosePath
from conformodal.reasoning.places import choose_places, own_hypotheses
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.smoother import smooth

# The poses that a robot gets, each when its frame comes and from the frames so far; all others see later frames too.
ONLINE = "online"
# The first is the answer of a run.
METHODS = ("smoothed", "hindsight", ONLINE)
PAPERS_METHOD = "greedy"


def whole_paths(
    seen: Observations, prior: MotionPrior, forward: Sequence[Posterior] | None = None
) -> dict[str, Trajectory]:
    """The paths that need all frames of a recording: the most probable place of each frame, and that path smoothed.

    Parameters
    ----------
    seen, prior, forward
        As for :func:`~conformodal.reasoning.filter.hindsight_posteriors`.
    """
    best, _ = choose_places(hindsight_posteriors(seen, prior, forward), seen.timestamps_s, prior)
    smoothed = smooth(own_hypotheses(best, seen, prior), seen, prior)
    return {"smoothed": as_trajectory(smoothed), "hindsight": as_trajectory(best)}


def rows_by_recording(recording: IntArray) -> list[IntArray]:
    """Rows of each recording, from the numbers (n,) of the recordings: motion is never linked across recordings."""
    return [np.flatnonzero(recording == number) for number in np.unique(recording)]


def as_trajectory(path: PosePath) -> Trajectory:
    """The poses of a path."""
    return Trajectory(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)
