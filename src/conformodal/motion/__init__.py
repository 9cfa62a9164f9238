"""Motion between frames: corners, flow, two-view geometry, submaps and landmarks (OpenCV, PoseLib)."""

from .essential import EssentialFrontEnd
from .frontend import FrontEnd, MotionFrontEnd
from .landmarks import Described, LandmarkMap, Matcher, build_map, describe, match
from .relative_pose import estimate_relative_motion
from .submaps import build_submaps
from .tracker import Corners, CornerTracker, TrackerConfig, grey_image
from .two_view import TwoView, TwoViewSolver, solve_opencv, solve_poselib
from .undistortion import undistort

__all__ = [
    "CornerTracker",
    "Corners",
    "Described",
    "EssentialFrontEnd",
    "FrontEnd",
    "LandmarkMap",
    "Matcher",
    "MotionFrontEnd",
    "TrackerConfig",
    "TwoView",
    "TwoViewSolver",
    "build_map",
    "build_submaps",
    "describe",
    "estimate_relative_motion",
    "grey_image",
    "match",
    "solve_opencv",
    "solve_poselib",
    "undistort",
]
