"""Frames one after the other, in constant memory: of data sets, videos, cameras and ROS recordings."""

from .frames import Frame, FrameStream, SourceError
from .opening import open_stream
from .prefetch import Pace, prefetch
from .stored import RecordingStream

__all__ = ["Frame", "FrameStream", "Pace", "RecordingStream", "SourceError", "open_stream", "prefetch"]
