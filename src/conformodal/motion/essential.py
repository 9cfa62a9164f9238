"""Relative motion as in section 3 of the paper: corners, flow and an essential matrix, without degeneracy checks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from conformodal.poses import MotionStatus, PinholeCamera, RelativeMotion

from .tracker import Corners, CornerTracker, TrackerConfig, grey_image
from .two_view import solve_opencv
from .undistortion import undistort

_FIVE = 5  # corners that an essential matrix needs


class EssentialFrontEnd:
    """Rotation and direction from frame to frame, by OpenCV's essential matrix.

    :class:`~conformodal.motion.MotionFrontEnd` detects pure rotation, small steps, planes and repeated pictures. This
    class does not: it gives a direction whenever it finds a matrix. Both have the same interface.

    Parameters
    ----------
    camera
        Intrinsics and distortion.
    config
        Of the corner tracker.

    Attributes
    ----------
    tracks, corners
        As in :class:`~conformodal.motion.MotionFrontEnd`.
    """

    def __init__(self, camera: PinholeCamera, config: TrackerConfig | None = None) -> None:
        self.camera = camera
        self.tracker = CornerTracker(config)
        self.tracks: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None
        self.corners: Corners = self.tracker.corners()

    def reset(self) -> None:
        """Start a new recording."""
        self.tracker.reset()

    def pass_by(self, image: npt.NDArray[np.uint8]) -> None:
        """Follow corners through a frame (height, width[, 3]) that no motion is asked for."""
        self.tracker.advance(grey_image(image))

    def measure(self, image: npt.NDArray[np.uint8]) -> RelativeMotion | None:
        """Motion from the frame measured last to this one; None for the first frame of a recording."""
        first = not self.tracker.started
        self.tracker.advance(grey_image(image))
        self.tracks = None if first else self.tracker.pairs()
        motion = None if self.tracks is None else self._motion(*self.tracks)
        self.tracker.mark()
        self.corners = self.tracker.corners()
        return motion

    def _motion(self, before: npt.NDArray[np.float64], now: npt.NDArray[np.float64]) -> RelativeMotion:
        n = len(before)
        if n < _FIVE:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=n)
        found = solve_opencv(undistort(before, self.camera), undistort(now, self.camera), self.camera)
        if found is None:
            return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n)
        n_inliers = int(found.inliers.sum())
        return RelativeMotion(MotionStatus.OK, found.R_prev_next, found.direction_prev, n, n_inliers)
