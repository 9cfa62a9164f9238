"""All answers about the frames of one recording, by method."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from conformodal.poses import Trajectory
from conformodal.reasoning import IntervalMeans, MotionPrior, Observations, PosePath, greedy, smooth, viterbi

FloatArray = npt.NDArray[np.float64]

# Final answer first; the others are kept for comparison.
METHODS = ("smoothed", "viterbi", "online", "greedy", "softmax_mean")
PAPERS_ANSWER = "greedy"

# Answers of methods from elsewhere to the same frames: features (n, F), and what reasoning knows.
OtherMethods = Callable[[npt.NDArray[np.float32], Observations, MotionPrior], dict[str, Trajectory]]


def answers(
    seen: Observations, paper: Sequence[IntervalMeans], mean: FloatArray, prior: MotionPrior
) -> dict[str, Trajectory]:
    """The answer and what it is compared with, but for the fixed-lag search.

    Parameters
    ----------
    seen
        n frames of one recording.
    paper
        Intervals of the same frames, which the paper's reasoning chooses among.
    mean
        (n, 7) means of the softmax.
    prior
        Motion to expect.
    """
    best = viterbi(seen, prior)
    paths = {
        "smoothed": smooth(best, seen, prior),
        "viterbi": best,
        "greedy": greedy(paper, seen.motions, seen.timestamps_s),
    }
    found = {name: as_trajectory(path) for name, path in paths.items()}
    found["softmax_mean"] = Trajectory(seen.timestamps_s, mean[:, :3], mean[:, 3:])
    return found


def as_trajectory(path: PosePath) -> Trajectory:
    """The poses of a path."""
    return Trajectory(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)
