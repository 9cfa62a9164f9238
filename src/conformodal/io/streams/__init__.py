"""Frames one after the other, in constant memory: of data sets, videos, cameras and ROS recordings."""

from .bag import BagStream
from .frames import Frame, FrameStream, SourceError
from .opening import open_stream
from .prefetch import Pace, prefetch
from .ros_messages import COMPRESSED, INFO, RAW, camera_of_info, image_of
from .stored import SequenceStream
from .video import CameraStream, VideoStream

__all__ = [
    "COMPRESSED",
    "INFO",
    "RAW",
    "BagStream",
    "CameraStream",
    "Frame",
    "FrameStream",
    "Pace",
    "SequenceStream",
    "SourceError",
    "VideoStream",
    "camera_of_info",
    "image_of",
    "open_stream",
    "prefetch",
]
