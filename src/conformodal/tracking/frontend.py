"""From images to relative motions: the tracker and the two-view geometry behind one small class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import reduce

import numpy as np

from conformodal.core.arrays import FloatArray, UInt8Array
from conformodal.geometry import MotionStatus, PinholeCamera, RelativeMotion
from conformodal.io.decoding import grey_image

from .relative_pose import estimate_relative_motion
from .settings import RELATIVE_POSE
from .tracker import Corners, CornerTracker
from .two_view import TwoViewSolver, solve_opencv, solve_poselib


class FrontEnd(ABC):
    """Relative motion between frames of one camera.

    :meth:`track_only` tracks through an intermediate frame; :meth:`measure` ends an interval and starts the next.

    Attributes
    ----------
    tracks
        Pixels (m, 2) of the same corners in the last measured frame and in the one before, or a later one where corners
        were renewed between; None for the first frame.
    corners
        All corners of the last measured frame, for :func:`~conformodal.tracking.submaps.build_submaps`.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = camera
        self.tracker = CornerTracker()
        self.tracks: tuple[FloatArray, FloatArray] | None = None
        self.corners: Corners = self.tracker.corners()

    def reset(self) -> None:
        """Start a new recording."""
        self.tracker.reset()

    def track_only(self, image: UInt8Array) -> None:
        """Track corners through a frame (height, width[, 3]) without measuring a motion."""
        self.tracker.advance(grey_image(image))

    def measure(self, image: UInt8Array) -> RelativeMotion | None:
        """Motion from the frame measured last to this one; None for the first frame of a recording."""
        first = not self.tracker.started
        self.tracker.advance(grey_image(image))
        self.tracks = None if first else self.tracker.pairs()
        motion = None if self.tracks is None else self._motion(*self.tracks)
        self.tracker.mark()
        self.corners = self.tracker.corners()
        return motion

    @abstractmethod
    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        """Motion between the marked frame and the current one, from the pixels (n, 2) of the same corners."""


class MotionFrontEnd(FrontEnd):
    """Relative motions with checks for pure rotation, small steps, planes and repeated pictures.

    If corners had to be renewed within an interval, rotations are chained and the direction, which would need the
    lengths of the parts, is left out.
    """

    def __init__(self, camera: PinholeCamera, solver: TwoViewSolver = solve_poselib) -> None:
        super().__init__(camera)
        self.solver = solver
        self._parts: list[RelativeMotion] = []  # from the frame measured last to the mark

    def reset(self) -> None:
        """As of the class above."""
        super().reset()
        self._parts = []

    def track_only(self, image: UInt8Array) -> None:
        """As of the class above; corners are renewed where most of them are lost."""
        super().track_only(image)
        if len(self.tracker.pairs()[0]) < RELATIVE_POSE.remark_below * self.tracker.n_at_mark:
            self._renew_corners()

    def measure(self, image: UInt8Array) -> RelativeMotion | None:
        """As of the class above, but with status ``TOO_FEW`` if the first frame of a recording is blank."""
        motion = super().measure(image)
        if motion is None and self.tracker.n_at_mark < RELATIVE_POSE.min_tracks:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=self.tracker.n_at_mark)
        return motion

    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        parts, self._parts = self._parts, []
        return _chain(parts, self._since_mark(before, now))

    def _since_mark(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        return estimate_relative_motion(before, now, self.camera, self.tracker.n_at_mark, self.solver)

    def _renew_corners(self) -> None:
        self._parts.append(self._since_mark(*self.tracker.pairs()))
        self.tracker.mark()


def _chain(parts: list[RelativeMotion], last: RelativeMotion) -> RelativeMotion:
    """The rotation of all motions one after another; the last one where it is alone."""
    if not parts:
        return last
    rotations = [part.R_prev_next for part in (*parts, last) if part.R_prev_next is not None]
    if len(rotations) <= len(parts):
        broken = any(not part.reliable for part in parts)
        status = MotionStatus.LOST if broken else last.status
        return RelativeMotion(status, n_tracks=last.n_tracks, n_inliers=last.n_inliers)
    variance = sum(part.rotation_sigma_rad**2 for part in (*parts, last))
    return RelativeMotion(
        MotionStatus.LOW_PARALLAX,
        reduce(np.matmul, rotations),
        None,
        last.n_tracks,
        last.n_inliers,
        rotation_sigma_rad=float(np.sqrt(variance)),
    )


class EssentialFrontEnd(FrontEnd):
    """Rotation and direction by OpenCV's essential matrix, as in section 3 of the paper.

    It has none of the checks of :class:`MotionFrontEnd`: it gives a direction whenever it finds a matrix.
    """

    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        n = len(before)
        if n < RELATIVE_POSE.essential_corners:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=n)
        view = solve_opencv(self.camera.undistort(before), self.camera.undistort(now), self.camera)
        if view is None:
            return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n)
        n_inliers = int(view.inliers.sum())
        return RelativeMotion(MotionStatus.OK, view.R_prev_next, view.direction_prev, n, n_inliers)
