"""How the camera moves and how deep it looks, learnt in training: speeds, turning, changes of velocity, depths."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray, rows_by_label
from conformodal.geometry import RelativeMotion, Trajectory, angle_between_quats

from .errors import ReasoningError
from .settings import FILTER, MOTION_PRIOR


@dataclass(frozen=True)
class MotionPrior:
    """Statistics of camera motion.

    Attributes
    ----------
    turn_rate_rad_s
        Root mean square of the turning rate.
    intervals_s
        Time steps that the rest was measured at. Real motion is no white noise: shaking is fast, flying is not.
    top_speed_mps
        Speed that hardly any step of that length exceeds (the 99.5th percentile, and a tenth more).
    acceleration_density
        Variance of velocity changes per second, m^2/s^3 and per axis.
    depth_m, depth_spread
        Median depth of the corners in view, and the spread of its logarithm; NaN where nothing is known.
    volume_m3
        Of the box around the training positions, at least a millimetre wide.
    """

    turn_rate_rad_s: float
    intervals_s: tuple[float, ...]
    top_speed_mps: tuple[float, ...]
    acceleration_density: tuple[float, ...]
    depth_m: float = math.nan
    depth_spread: float = math.nan
    volume_m3: float = 1.0

    @property
    def place_m(self) -> float:
        """Distance within which poses are of one place: a share of the depth, or of a metre where it is not known."""
        return FILTER.place * self.scale_m

    @property
    def scale_m(self) -> float:
        """The depth; one metre where it is not known."""
        return self.depth_m if math.isfinite(self.depth_m) else 1.0

    def reach_m(self, step_s: float) -> float:
        """How far the camera can get within a time step, in metres."""
        return step_s * float(np.interp(step_s, self.intervals_s, self.top_speed_mps))

    def density_at(self, step_s: FloatArray) -> FloatArray:
        """Velocity-change density for mean time steps (n,), interpolated between the measured ones."""
        logs = np.interp(np.log(step_s), np.log(self.intervals_s), np.log(self.acceleration_density))
        return np.asarray(np.exp(logs))


def rotation_sigma(motion: RelativeMotion) -> float:
    """Standard deviation of a relative rotation in radians, beside the errors of hypotheses."""
    return FILTER.rotation_sigma_factor * motion.rotation_sigma_rad


def fit_motion_prior(truth: Trajectory, recording: IntArray) -> MotionPrior:
    """Learn the prior from the training frames, in order of time; gaps between them are allowed."""
    turns: list[FloatArray] = []
    levels: dict[int, list[FloatArray]] = {}
    for rows in rows_by_label(recording):
        part = truth[rows]
        if len(part) < 3:
            continue
        quats = part.orientations_quat_wxyz
        turns.append(angle_between_quats(quats[1:], quats[:-1]) / np.diff(part.timestamps_s))
        for every in MOTION_PRIOR.decimations:
            sparse = part[::every]
            if len(sparse) >= 3:
                levels.setdefault(every, []).append(_changes(sparse))
    if not turns:
        raise ReasoningError("a motion prior needs at least three frames of one recording")
    table: list[tuple[float, float, float]] = []
    for every in sorted(levels):
        step, speed, density = np.concatenate(levels[every], axis=1)
        if not table or np.median(step) > table[-1][0]:
            usual = density[density <= np.quantile(density, MOTION_PRIOR.usual_quantile)].mean()
            top = MOTION_PRIOR.top_factor * float(np.quantile(speed, MOTION_PRIOR.top_quantile))
            table.append((float(np.median(step)), top, float(usual)))
    intervals, speeds, densities = zip(*table, strict=True)
    return MotionPrior(
        turn_rate_rad_s=float(np.sqrt(np.mean(np.concatenate(turns) ** 2))) + 1e-9,
        intervals_s=intervals,
        top_speed_mps=tuple(max(v, 1e-9) for v in speeds),
        acceleration_density=tuple(max(q, 1e-12) for q in densities),
        volume_m3=float(np.prod(np.maximum(np.ptp(truth.positions_xyz, axis=0), 1e-3))),
    )


def _changes(part: Trajectory) -> FloatArray:
    """Mean time step, speed, and squared velocity change per second and axis, (3, n - 2)."""
    dt = np.diff(part.timestamps_s)
    velocity = np.diff(part.positions_xyz, axis=0) / dt[:, None]
    step = (dt[1:] + dt[:-1]) / 2
    speed = np.linalg.norm(velocity, axis=1)[1:]
    return np.stack((step, speed, np.sum(np.diff(velocity, axis=0) ** 2, axis=1) / 3 / step))
