"""Frames one after the other, in constant memory: of data sets, videos, cameras and ROS recordings."""

from .bag import BagStream
from .frames import Frame, FrameStream, SourceError
from .opening import open_stream
from .prefetch import Pace, prefetch
from .stored import SequenceStream
from .video import CameraStream, VideoStream

__all__ = [
    "BagStream",
    "CameraStream",
    "Frame",
    "FrameStream",
    "Pace",
    "SequenceStream",
    "SourceError",
    "VideoStream",
    "open_stream",
    "prefetch",
]
