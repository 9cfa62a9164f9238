"""Errors of motion rather than of place: relative pose error, and KITTI's drift over stretches of road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray

from .errors import PoseError
from .metrics import check_same_length
from .trajectory import Trajectory

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_EVERY = 10  # frames between the starts of stretches


def relative_errors(estimate: Trajectory, truth: Trajectory, delta: int = 1) -> tuple[FloatArray, FloatArray]:
    """Errors of the motion from every pose to the one `delta` frames later (Sturm et al. 2012, eq. 2).

    Returns
    -------
    metres (n - delta,), degrees (n - delta,)

    Raises
    ------
    PoseError
        If lengths differ, or there are not more than `delta` poses.
    """
    check_same_length(estimate, truth)
    if delta < 1 or len(truth) <= delta:
        raise PoseError(
            f"relative errors need delta of at least 1 and more than delta poses, got {delta}, {len(truth)}"
        )
    starts = np.arange(len(truth) - delta)
    return _motion_errors(estimate, truth, starts, starts + delta)


@dataclass(frozen=True)
class KittiDrift:
    """Drift over stretches of 100 to 800 m (Geiger, Lenz and Urtasun 2012).

    Attributes
    ----------
    translation_percent
        Error of translation, per cent of the length, mean over stretches.
    rotation_deg_per_m
        Error of rotation per metre.
    by_length
        The two by nominal length in metres.
    n_stretches
        How many there are.
    """

    translation_percent: float
    rotation_deg_per_m: float
    by_length: dict[float, tuple[float, float]]
    n_stretches: int


def kitti_drift(estimate: Trajectory, truth: Trajectory) -> KittiDrift:
    """KITTI's drift: stretches start at every tenth frame and end where the true path has the nominal length.

    Raises
    ------
    PoseError
        If lengths differ, or the true path is shorter than 100 m.
    """
    check_same_length(estimate, truth)
    steps = np.linalg.norm(np.diff(truth.positions_xyz, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    by_length: dict[float, tuple[float, float]] = {}
    percents, rates = [], []
    for length in KITTI_LENGTHS_M:
        starts = np.arange(0, len(truth), _KITTI_EVERY)
        ends = np.searchsorted(along, along[starts] + length, side="right")  # the first frame beyond
        inside = ends < len(truth)
        if not inside.any():
            continue
        metres, degrees = _motion_errors(estimate, truth, starts[inside], ends[inside])
        percents.append(100 * metres / length)
        rates.append(degrees / length)
        by_length[length] = (float(percents[-1].mean()), float(rates[-1].mean()))
    if not percents:
        raise PoseError(f"the true path is {along[-1]:.1f} m long; drift needs stretches of at least 100 m")
    percent, rate = np.concatenate(percents), np.concatenate(rates)
    return KittiDrift(float(percent.mean()), float(rate.mean()), by_length, len(percent))


def _motion_errors(
    estimate: Trajectory, truth: Trajectory, starts: IntArray, ends: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Sizes of ``(truth_i^-1 truth_j)^-1 (estimate_i^-1 estimate_j)``, in metres and degrees."""
    motions = []
    for path in (truth, estimate):
        rotation = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True)
        back = rotation[starts].inv()
        motions.append((back * rotation[ends], back.apply(path.positions_xyz[ends] - path.positions_xyz[starts])))
    (R_true, t_true), (R, t) = motions
    # turning the difference back into the frame at the end does not change its length
    return np.linalg.norm(t - t_true, axis=1), np.degrees((R_true.inv() * R).magnitude())
