"""Relative motion between frames: corners, flow and two-view geometry (OpenCV, PoseLib)."""

from .frontend import MotionFrontEnd
from .relative_pose import estimate_relative_motion
from .tracker import CornerTracker, TrackerConfig
from .two_view import TwoView, TwoViewSolver, solve_opencv, solve_poselib
from .undistortion import undistort

__all__ = [
    "CornerTracker",
    "MotionFrontEnd",
    "TrackerConfig",
    "TwoView",
    "TwoViewSolver",
    "estimate_relative_motion",
    "solve_opencv",
    "solve_poselib",
    "undistort",
]
