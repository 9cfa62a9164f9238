"""Frames one after the other, in constant memory: of data sets, videos, cameras and ROS recordings."""

from __future__ import annotations

import re
from pathlib import Path

from conformodal.core.files import kind_of_file
from conformodal.geometry import PinholeCamera
from conformodal.io.registry import Layout, read_recording

from .bag import is_bag, open_bag
from .frames import Frame, FrameStream, RecordingStream, SourceError, prefetch
from .video import CameraStream, open_video

__all__ = ["Frame", "FrameStream", "RecordingStream", "SourceError", "open_stream", "prefetch"]

_CAMERA = re.compile(r"camera:([0-9]{1,9})$")


def open_stream(
    source: Path | str, layout: str = Layout.AUTO, *, camera: PinholeCamera | None = None, topic: str | None = None
) -> FrameStream:
    """Open a source: a data set's folder, a video file, a ROS recording, or ``camera:0``.

    ``examples/stream.py`` answers its frames.

    Parameters
    ----------
    source
        What to read.
    layout
        Of a folder.
    camera
        Intrinsics of videos and cameras, and of recordings that have none.
    topic
        Of the images of a ROS recording with several.

    Raises
    ------
    DatasetError
        If it cannot be opened, or there is no such layout.
    """
    path = Path(source)
    if match := _CAMERA.match(str(source)):
        return CameraStream(int(match[1]), camera)
    if kind := kind_of_file(path):
        raise SourceError(f"{path}: {kind}")
    if layout == Layout.AUTO and is_bag(path):
        return open_bag(path, topic, camera)
    if layout == Layout.AUTO and path.is_file():
        return open_video(path, camera)
    return RecordingStream(read_recording(path, layout, require_poses=False, camera=camera))
