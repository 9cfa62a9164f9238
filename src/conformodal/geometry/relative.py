"""Relative motion: between two frames, and of a short piece of the path."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.ranges import as_member

from .rotations import PoseError


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


@dataclass(frozen=True, eq=False)
class Submap:
    """Poses of a few frames relative to the first of them, its anchor, up to one unknown length: the submap's unit.

    Attributes
    ----------
    frames
        (k,) increasing numbers of the frames; the anchor first.
    R_anchor_frame
        (k, 3, 3): takes directions from each camera's frame to the anchor's; the first is the identity.
    positions
        (k, 3) camera centres in the anchor's camera frame; the first is zero.
    depth
        Median depth of the corners, seen from the anchor.
    sigma
        Spread of the errors of `positions`, per axis.
    rotation_sigma_rad
        Spread of the errors of `R_anchor_frame`, about each axis.
    """

    frames: IntArray
    R_anchor_frame: FloatArray
    positions: FloatArray
    depth: float
    sigma: float
    rotation_sigma_rad: float

    @property
    def span(self) -> int:
        """Frames from the anchor to the last, those between that are not part of it counted in."""
        return int(self.frames[-1] - self.frames[0]) + 1
