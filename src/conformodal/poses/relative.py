"""What two frames say about the motion between them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.choices import as_member

from .errors import PoseError

# A direction is trusted if its error is claimed to be no larger.
_TRUSTED_DIRECTION_RAD = np.radians(10.0)


class MotionStatus(StrEnum):
    """What a pair of frames allowed; everything but ``OK`` leaves the direction out."""

    OK = "ok"
    LOW_PARALLAX = "low_parallax"  # rotation sound, direction not: pure rotation, or far too small a step
    PLANE = "plane"  # all corners on one plane, which two motions explain; rotation with a wide spread
    REPEATED = "repeated"  # the same picture twice
    TOO_FEW = "too_few_corners"  # black, blank, blurred or covered
    LOST = "lost"  # a cut: the corners are not found again
    INCONSISTENT = "inconsistent"  # corners moved, but by no single motion


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Motion from a previous camera frame to the next one.

    Attributes
    ----------
    status
        What the pair allowed.
    R_prev_next
        (3, 3) or None: takes directions from the next camera's frame to the previous one's, so that
        ``R_world_next = R_world_prev @ R_prev_next``.
    direction_prev
        (3,) or None: unit vector from the previous camera centre to the next, in the previous camera's frame.
    n_tracks, n_inliers
        Corners followed, and those that agree with the motion.
    parallax_rad
        Median angle by which inliers moved beyond what rotation explains.
    rotation_sigma_rad
        Spread of the rotation's error about each axis.
    direction_sigma_rad
        Spread of the direction's error.

    Raises
    ------
    PoseError
        If `status` is not one of :class:`MotionStatus`.
    """

    status: MotionStatus
    R_prev_next: FloatArray | None = None
    direction_prev: FloatArray | None = None
    n_tracks: int = 0
    n_inliers: int = 0
    parallax_rad: float = 0.0
    rotation_sigma_rad: float = np.inf
    direction_sigma_rad: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", as_member(self.status, MotionStatus, "status", PoseError))

    @property
    def reliable(self) -> bool:
        """Whether at least the rotation can be trusted."""
        return self.R_prev_next is not None

    @property
    def direction_trusted(self) -> bool:
        """Whether there is a direction with a claimed spread of at most 10 degrees; others still weigh, by theirs."""
        return self.direction_prev is not None and self.direction_sigma_rad <= _TRUSTED_DIRECTION_RAD
