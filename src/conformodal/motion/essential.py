"""Relative motion as in section 3 of the paper: corners, flow and an essential matrix, without degeneracy checks."""

from __future__ import annotations

from conformodal.core.arrays import FloatArray
from conformodal.poses import MotionStatus, RelativeMotion

from .frontend import FrontEnd
from .two_view import solve_opencv
from .undistortion import undistort

_FIVE = 5  # corners that an essential matrix needs


class EssentialFrontEnd(FrontEnd):
    """Rotation and direction from frame to frame, by OpenCV's essential matrix.

    :class:`~conformodal.motion.frontend.MotionFrontEnd` detects pure rotation, small steps, planes and repeated
    pictures. This class does not: it gives a direction whenever it finds a matrix.
    """

    def _motion(self, before: FloatArray, now: FloatArray) -> RelativeMotion:
        n = len(before)
        if n < _FIVE:
            return RelativeMotion(MotionStatus.TOO_FEW, n_tracks=n)
        found = solve_opencv(undistort(before, self.camera), undistort(now, self.camera), self.camera)
        if found is None:
            return RelativeMotion(MotionStatus.INCONSISTENT, n_tracks=n)
        n_inliers = int(found.inliers.sum())
        return RelativeMotion(MotionStatus.OK, found.R_prev_next, found.direction_prev, n, n_inliers)
