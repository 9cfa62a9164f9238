"""A guarantee for the chosen pose: the whole procedure, from frames to one trajectory, calibrated on whole recordings.

A region keeps its guarantee because nothing was chosen; choosing one place in it voids that. Here the chosen pose gets
a guarantee of its own: recordings that the model has not seen are answered from first frame to last, and how far the
answers were off becomes a radius around the answers to come.
"""

from __future__ import annotations

import numpy as np

from conformodal.conformal.checks import Alpha
from conformodal.core.arrays import FloatArray, IntArray, rows_by_label
from conformodal.core.progress import StageProgress
from conformodal.core.ranges import as_member
from conformodal.core.words import counted
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.localizer.radius import (
    Guarantee,
    PoseRadius,
    check_metres_per_rad,
    depth_or_default,
    fit_pose_radius,
    pose_errors,
)

from .errors import OdometryError
from .estimates import OdometryRun
from .estimator import VisualOdometry
from .identity import identify
from .model import METHODS, PoseModel


def calibrate_selection(
    model: PoseModel,
    sequence: Recording,
    alpha: Alpha = 0.1,
    guarantee: Guarantee | str = Guarantee.FRAME,
    method: str = METHODS[0],
    metres_per_rad: float | None = None,
    *,
    progress: StageProgress | None = None,
) -> PoseRadius:
    """Answer whole recordings with known poses, and turn the errors into a radius.

    Parameters
    ----------
    model
        Trained on other recordings.
    sequence
        Recordings to calibrate on, the more the better: fewer than ``1 / alpha - 1`` leave the radius infinite.
    alpha, guarantee, method
        See :class:`PoseRadius`.
    metres_per_rad
        How many metres of position weigh as much as one radian; None for the scene's depth, as training found it. The
        guarantee is exact as long as the true poses of these recordings had no part in choosing it.
    progress
        As for :meth:`~conformodal.VisualOdometry.process`.

    Raises
    ------
    OdometryError
        If a frame is one of the data set that the model was trained on, the method or the guarantee is
        unknown, or `metres_per_rad` is not positive and finite. A frame of its test part is refused too: the model
        knows the recording around it.
    PoseError
        If the sequence has no poses.
    """
    if method not in METHODS:
        raise OdometryError(f"method must be one of {list(METHODS)}, got {method!r}")
    guarantee = as_member(guarantee, Guarantee, "guarantee", OdometryError)  # before hours of work
    known = model.known_frames.known(identify(sequence))
    if known.any():
        raise OdometryError(
            f"{sequence.image_paths[int(known.argmax())]}: is a frame of the data set the model was trained on, as "
            f"{known.sum()} of {counted(len(known), 'frame')} are; calibrate on other recordings"
        )
    # the depth was learnt in training, so it knows nothing of these recordings
    given = depth_or_default(model.prior.depth_m) if metres_per_rad is None else metres_per_rad
    depth = check_metres_per_rad(given)
    truth = sequence.require_truth()
    run = VisualOdometry(model).process(sequence, progress=progress)
    return fit_pose_radius(
        recording_errors(run, method, truth, sequence.recording),
        alpha,
        guarantee,
        method,
        metres_per_rad=depth,
    )


def recording_errors(
    run: OdometryRun, method: str, truth: Trajectory, recording: IntArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Errors of a run, one pair of vectors a recording. A frame that could not be read is infinitely far off."""
    position, angle = np.full(len(truth), np.inf), np.full(len(truth), np.inf)
    position[run.frames], angle[run.frames] = pose_errors(run.trajectories[method], truth[run.frames])
    return [(position[rows], angle[rows]) for rows in rows_by_label(recording)]
