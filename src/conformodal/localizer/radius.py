"""A radius around the chosen pose, and what it guarantees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import ceil

import numpy as np
import numpy.typing as npt

from conformodal.conformal import hierarchical_maximum_quantile, hierarchical_quantile
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.core.ranges import as_member
from conformodal.geometry import Trajectory, orientation_errors_deg, position_errors_m

from . import LocalizationError

# Where no scene's depth is known: a pose d metres off moves the view of things at a depth of z metres as much as one
# turned by d / z radians, and rooms are some two metres deep. Other values: benchmarks/results/radius.md.
METRES_PER_RAD = 2.0


class Guarantee(StrEnum):
    """What is guaranteed in a new recording, with probability 1 - alpha."""

    FRAME = "frame"  # a frame of it, drawn at random, lies within the radius
    RECORDING = "recording"  # all its frames do


@dataclass(frozen=True)
class PoseRadius:
    """How far the true pose may be from the chosen one.

    One threshold bounds both errors: a pose is within the radius if the larger of its angle and its distance over
    `metres_per_rad` is at most the threshold, so alpha is not divided between the two. The guarantee is exact because
    `metres_per_rad` does not depend on the true poses of the recordings that calibrate.
    """

    radius_rad: float  # of the orientation; infinite where there were too few recordings
    alpha: float  # miscoverage rate of position and orientation together
    guarantee: Guarantee
    method: str  # the path that it is about, one of conformodal.pipeline.model.METHODS
    n_recordings: int  # that calibrated it
    # metres of position that weigh as much as one radian: the depth of the scene
    metres_per_rad: float = METRES_PER_RAD

    def __post_init__(self) -> None:
        object.__setattr__(self, "guarantee", as_member(self.guarantee, Guarantee, "guarantee", LocalizationError))

    @property
    def radius_m(self) -> float:
        """Radius of the position, in metres."""
        return self.radius_rad * self.metres_per_rad

    @property
    def radius_deg(self) -> float:
        """Radius of the orientation, in degrees; at most 180, or infinite."""
        degrees = float(np.degrees(self.radius_rad))
        return min(degrees, 180.0) if np.isfinite(degrees) else degrees

    @property
    def assumption(self) -> str:
        """The guarantee and its assumption in a sentence."""
        what = "every frame" if self.guarantee is Guarantee.RECORDING else "a frame drawn at random"
        return (
            f"If a recording is exchangeable with the {self.n_recordings} that the radius was calibrated on, the true "
            f"pose of {what} of it is within the radius with probability at least {1 - self.alpha:g}."
        )

    def holds(self, estimate: Trajectory, truth: Trajectory) -> BoolArray:
        """Whether each true pose (n,) is within the radius of its estimate."""
        # the score that was calibrated, so that rounding puts nothing beyond a radius that it made
        return np.asarray(joint_error(*pose_errors(estimate, truth), self.metres_per_rad) <= self.radius_rad)


def depth_or_default(depth_m: float) -> float:
    """How many metres weigh as much as one radian: the depth of the scene, or the default where that is NaN."""
    return depth_m if np.isfinite(depth_m) else METRES_PER_RAD


def joint_error(position_m: npt.ArrayLike, angle_rad: npt.ArrayLike, metres_per_rad: float) -> FloatArray:
    """One error of a pose in radians: the larger of its angle and its distance over `metres_per_rad`."""
    return np.maximum(np.asarray(position_m, dtype=np.float64) / metres_per_rad, angle_rad)


def recordings_needed(alpha: Alpha) -> int:
    """Least number of recordings for a finite radius: 9 at alpha = 0.1."""
    return ceil(1 / as_alpha(alpha)) - 1


def pose_errors(estimate: Trajectory, truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) in metres and angles (n,) in radians between two trajectories of the same frames."""
    return position_errors_m(estimate, truth), np.radians(orientation_errors_deg(estimate, truth))


def fit_pose_radius(
    errors: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    alpha: Alpha,
    guarantee: Guarantee,
    method: str,
    *,
    metres_per_rad: float = METRES_PER_RAD,
) -> PoseRadius:
    """Radius from the errors of held-out recordings: of each a pair of vectors, see :func:`pose_errors`.

    For the others see :class:`PoseRadius`; `metres_per_rad` must not depend on the true poses of these recordings.
    """
    if not (metres_per_rad > 0 and np.isfinite(metres_per_rad)):
        raise LocalizationError(f"metres_per_rad must be positive and finite, got {metres_per_rad}")
    scores = [joint_error(metres, np.asarray(radians), metres_per_rad) for metres, radians in errors]
    quantile = hierarchical_quantile if guarantee is Guarantee.FRAME else hierarchical_maximum_quantile
    limit = quantile(scores, alpha)
    return PoseRadius(limit, float(as_alpha(alpha)), guarantee, method, len(errors), metres_per_rad)
