"""Relative motion between frames: corners, flow and two-view geometry (OpenCV, PoseLib)."""

from .frontend import MotionFrontEnd
from .relative_pose import estimate_relative_motion
from .tracker import CornerTracker, TrackerConfig

__all__ = ["CornerTracker", "MotionFrontEnd", "TrackerConfig", "estimate_relative_motion"]
