"""A radius around the chosen pose, and what it promises."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from conformodal.conformal import grouped_maximum_quantile, grouped_quantile
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.poses import Trajectory, orientation_errors_deg, position_errors_m


class Promise(StrEnum):
    """What holds with probability 1 - alpha in a new recording."""

    FRAME = "frame"  # a frame of it, drawn at random, lies within the radius
    RECORDING = "recording"  # all its frames do


@dataclass(frozen=True)
class PoseRadius:
    """How far the true pose may be from the chosen one.

    Attributes
    ----------
    radius_m, radius_rad
        Of position and orientation, together; infinite where there were too few recordings.
    alpha
        Miscoverage rate of the two together; each is calibrated at half of it.
    promise
        What holds with probability 1 - alpha.
    method
        Whose answer it is about, one of :data:`~conformodal.odometry.METHODS`.
    n_recordings
        Recordings behind it.
    """

    radius_m: float
    radius_rad: float
    alpha: float
    promise: Promise
    method: str
    n_recordings: int

    @property
    def assumption(self) -> str:
        """What the promise rests on, for people."""
        what = "every frame" if self.promise is Promise.RECORDING else "a frame drawn at random"
        return (
            f"If a recording is exchangeable with the {self.n_recordings} that the radius was calibrated on, the true "
            f"pose of {what} of it is within the radius with probability at least {1 - self.alpha:g}."
        )

    def holds(self, estimate: Trajectory, truth: Trajectory) -> npt.NDArray[np.bool_]:
        """Whether each true pose (n,) is within the radius of its estimate."""
        position, angle = pose_errors(estimate, truth)
        return np.asarray((position <= self.radius_m) & (angle <= self.radius_rad))


def pose_errors(estimate: Trajectory, truth: Trajectory) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Distances (n,) in metres and angles (n,) in radians between two trajectories of the same frames."""
    return position_errors_m(estimate, truth), np.radians(orientation_errors_deg(estimate, truth))


def fit_pose_radius(
    errors: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]],
    alpha: Alpha,
    promise: Promise,
    method: str,
) -> PoseRadius:
    """Radius from the errors of held-out recordings, one pair of vectors a recording, see :func:`pose_errors`.

    Raises
    ------
    ConformalError
        If a recording has no frames, errors are NaN, or `alpha` is outside (0, 1).
    """
    half = as_alpha(alpha) / 2
    quantile = grouped_quantile if promise is Promise.FRAME else grouped_maximum_quantile
    metres, radians = (quantile([pair[k] for pair in errors], half) for k in (0, 1))
    return PoseRadius(metres, radians, float(as_alpha(alpha)), promise, method, len(errors))
