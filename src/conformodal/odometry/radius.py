"""A radius around the chosen pose, and what it promises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import ceil

import numpy as np
import numpy.typing as npt

from conformodal.conformal import grouped_maximum_quantile, grouped_quantile
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core.choices import as_member
from conformodal.poses import Trajectory, orientation_errors_deg, position_errors_m

from .errors import OdometryError
from .sizing import METRES_PER_RAD, Sizing, check_metres_per_rad, joint_error, recording_size


class Promise(StrEnum):
    """What holds with probability 1 - alpha in a new recording."""

    FRAME = "frame"  # a frame of it, drawn at random, lies within the radius
    RECORDING = "recording"  # all its frames do


@dataclass(frozen=True)
class PoseRadius:
    """How far the true pose may be from the chosen one.

    One threshold holds both errors: a pose is within where the larger of its angle and its distance over
    `metres_per_rad` is at most the threshold, so no alpha is shared out between the two. The promise is exact because
    `metres_per_rad` and the sizes know nothing of the true poses of the recordings that calibrate.

    Attributes
    ----------
    radius_rad
        Of the orientation in a recording of size 1; infinite where there were too few recordings. That of the position
        is `radius_m`.
    alpha
        Miscoverage rate of the two together.
    promise
        What holds with probability 1 - alpha.
    method
        Whose answer it is about, one of :data:`~conformodal.odometry.METHODS`.
    n_recordings
        Recordings behind it.
    metres_per_rad
        How many metres of position weigh as much as one radian: the depth of the scene.
    sizing
        What a new recording's size is found by, see :meth:`size_of`.

    Raises
    ------
    OdometryError
        If `promise` or `sizing` is not one of those there are.
    """

    radius_rad: float
    alpha: float
    promise: Promise
    method: str
    n_recordings: int
    metres_per_rad: float = METRES_PER_RAD
    sizing: Sizing = Sizing.NONE

    def __post_init__(self) -> None:
        object.__setattr__(self, "promise", as_member(self.promise, Promise, "promise", OdometryError))
        object.__setattr__(self, "sizing", as_member(self.sizing, Sizing, "sizing", OdometryError))

    @property
    def radius_m(self) -> float:
        """Radius of the position in a recording of size 1, in metres."""
        return self.radius_rad * self.metres_per_rad

    def degrees(self, size: float = 1.0) -> float:
        """Radius of the orientation in degrees, in a recording of a size; at most 180, or infinite."""
        degrees = float(np.degrees(self.radius_rad)) * size
        return min(degrees, 180.0) if np.isfinite(degrees) else degrees

    @property
    def assumption(self) -> str:
        """What the promise rests on, for people."""
        what = "every frame" if self.promise is Promise.RECORDING else "a frame drawn at random"
        return (
            f"If a recording is exchangeable with the {self.n_recordings} that the radius was calibrated on, the true "
            f"pose of {what} of it is within the radius with probability at least {1 - self.alpha:g}."
        )

    def size_of(self, trajectory: Trajectory) -> float:
        """The factor of both radii in one recording, from its whole estimated trajectory and without its truth."""
        return recording_size(trajectory, self.sizing, self.alpha, self.metres_per_rad)

    def sizes_of(self, trajectory: Trajectory, recording: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Sizes (n,) of frames of several recordings, whose numbers (n,) are given.

        Raises
        ------
        OdometryError
            If there are not as many numbers as frames.
        """
        if len(recording) != len(trajectory):
            raise OdometryError(f"{len(trajectory)} poses need the numbers of their recordings, got {len(recording)}")
        sizes = np.ones(len(trajectory))
        for number in np.unique(recording):
            sizes[recording == number] = self.size_of(trajectory[recording == number])
        return sizes

    def holds(self, estimate: Trajectory, truth: Trajectory, sizes: npt.ArrayLike = 1.0) -> npt.NDArray[np.bool_]:
        """Whether each true pose (n,) is within the radius of its estimate; `sizes` one for all or (n,)."""
        # the score that was calibrated, so that rounding puts nothing beyond a radius that it made
        score = joint_error(*pose_errors(estimate, truth), self.metres_per_rad) / np.asarray(sizes, dtype=np.float64)
        return np.asarray(score <= self.radius_rad)


def recordings_needed(alpha: Alpha) -> int:
    """Least number of recordings for a finite radius: 9 at alpha = 0.1."""
    return ceil(1 / as_alpha(alpha)) - 1


def pose_errors(estimate: Trajectory, truth: Trajectory) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Distances (n,) in metres and angles (n,) in radians between two trajectories of the same frames."""
    return position_errors_m(estimate, truth), np.radians(orientation_errors_deg(estimate, truth))


def fit_pose_radius(
    errors: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    alpha: Alpha,
    promise: Promise | str,
    method: str,
    *,
    metres_per_rad: float = METRES_PER_RAD,
    sizing: Sizing | str = Sizing.NONE,
    sizes: Sequence[npt.ArrayLike] | None = None,
) -> PoseRadius:
    """Radius from the errors of held-out recordings.

    Parameters
    ----------
    errors
        One pair of vectors a recording, metres and radians, see :func:`pose_errors`.
    alpha, promise, method, sizing
        See :class:`PoseRadius`.
    metres_per_rad
        Must not be chosen by the true poses of these recordings.
    sizes
        Of each recording one size, or one a frame, found without its truth; all 1 by default. Errors are divided by
        it. Where it is not what `sizing` says, whoever asks :meth:`PoseRadius.holds` must give sizes of the same kind.

    Raises
    ------
    OdometryError
        If `metres_per_rad` or a size is not positive and finite, there are not as many sizes as recordings, or
        `promise` or `sizing` is not one of those there are.
    ConformalError
        If a recording has no frames, errors are NaN, or `alpha` is outside (0, 1).
    """
    check_metres_per_rad(metres_per_rad)
    promise = as_member(promise, Promise, "promise", OdometryError)
    sizing = as_member(sizing, Sizing, "sizing", OdometryError)
    if sizes is None:
        sizes = [1.0] * len(errors)
    if len(sizes) != len(errors):
        raise OdometryError(f"{len(errors)} recordings need as many sizes, got {len(sizes)}")
    scores = []
    for (metres, radians), own in zip(errors, sizes, strict=True):
        size = np.asarray(own, dtype=np.float64)
        if not ((size > 0) & np.isfinite(size)).all():
            raise OdometryError(f"sizes must be positive and finite, got {size.min()} to {size.max()}")
        scores.append(joint_error(metres, np.asarray(radians), metres_per_rad) / size)
    quantile = grouped_quantile if promise is Promise.FRAME else grouped_maximum_quantile
    limit = quantile(scores, alpha)
    rate = float(as_alpha(alpha))
    return PoseRadius(limit, rate, promise, method, len(errors), metres_per_rad, sizing)
