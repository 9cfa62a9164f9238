"""Motion between frames: corners, flow, two-view geometry and submaps (OpenCV, PoseLib)."""

from conformodal.core import needing

with needing("run", "measuring motion"):
    import cv2  # noqa: F401
    import poselib  # noqa: F401

from .essential import EssentialFrontEnd
from .frontend import FrontEnd, MotionFrontEnd
from .relative_pose import estimate_relative_motion
from .submaps import build_submaps
from .tracker import Corners, CornerTracker, grey_image
from .two_view import TwoViewSolver, solve_opencv, solve_poselib
from .undistortion import undistort

__all__ = [
    "CornerTracker",
    "Corners",
    "EssentialFrontEnd",
    "FrontEnd",
    "MotionFrontEnd",
    "TwoViewSolver",
    "build_submaps",
    "estimate_relative_motion",
    "grey_image",
    "solve_opencv",
    "solve_poselib",
    "undistort",
]
