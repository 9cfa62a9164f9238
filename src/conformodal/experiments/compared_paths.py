"""Paths from the same run to compare with the answer: greedy reasoning over its regions, and the softmax mean."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.odometry import OdometryRun, PoseModel, as_trajectory, rows_by_recording
from conformodal.poses import Trajectory, concatenate
from conformodal.reasoning import greedy, interval_runs, softmax_mean


def comparison_paths(run: OdometryRun, model: PoseModel, recording: npt.NDArray[np.int64]) -> dict[str, Trajectory]:
    """``softmax_mean``, and ``greedy`` where it is not the answer itself.

    Parameters
    ----------
    run, model
        The answers to n frames, and who gave them.
    recording
        (n,) the recording that each frame belongs to: motion is never linked across recordings.
    """
    beliefs = run.localization.beliefs
    mean = softmax_mean(beliefs.proba, model.bins)
    found = {"softmax_mean": Trajectory(run.timestamps_s, mean[:, :3], mean[:, 3:])}
    if run.answer == "greedy":
        return found
    intervals = interval_runs(model.localizer.marginals(beliefs), run.regions)
    pieces = rows_by_recording(recording)
    paths = (greedy([intervals[t] for t in at], [run.motions[t] for t in at], run.timestamps_s[at]) for at in pieces)
    return found | {"greedy": concatenate([as_trajectory(path) for path in paths])}
