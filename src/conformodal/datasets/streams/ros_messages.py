"""Images and cameras in ROS messages, whoever has read them: rosbags from a file, or rclpy from a topic."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from conformodal.datasets.cameras import UNDISTORT, camera_of, check_matrix
from conformodal.datasets.decoding import decode
from conformodal.datasets.errors import DatasetError
from conformodal.poses import PinholeCamera

from .frames import SourceError

RAW, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
# encoding: (channels, conversion to RGB or None)
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
_LENSES = ("plumb_bob", "radtan")


def image_of(message: Any, kind: str) -> npt.NDArray[np.uint8]:
    """The image (height, width, 3) RGB of a message.

    Parameters
    ----------
    message
        A ``sensor_msgs/Image``, or a ``sensor_msgs/CompressedImage``.
    kind
        Which of the two, :data:`RAW` or :data:`COMPRESSED`.

    Raises
    ------
    ValueError
        If its encoding is not known, or its bytes do not make such an image.
    """
    if kind == COMPRESSED:
        return decode(bytes(message.data), f"{message.format} data")
    if message.encoding not in _ENCODINGS:
        raise ValueError(f"encoding {message.encoding} is none of {', '.join(_ENCODINGS)}")
    channels, conversion = _ENCODINGS[message.encoding]
    data = np.frombuffer(message.data, dtype=np.uint8)
    if data.size != message.height * message.step or message.step < message.width * channels:
        raise ValueError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = data.reshape(message.height, message.step)[:, : message.width * channels]
    image: npt.NDArray[np.uint8] = np.ascontiguousarray(rows.reshape(message.height, message.width, channels))
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), dtype=np.uint8)


def camera_of_info(message: Any, place: str) -> PinholeCamera:
    """The camera of a ``sensor_msgs/CameraInfo``, ROS 1 or 2.

    Parameters
    ----------
    message
        Read already.
    place
        Where it comes from, for errors.

    Raises
    ------
    SourceError
        If the camera is no pinhole with a lens that is known, or its numbers are none of a camera.
    """
    k = np.asarray(message.K if hasattr(message, "K") else message.k, dtype=np.float64)
    d = np.asarray(message.D if hasattr(message, "D") else message.d, dtype=np.float64)
    lens = tuple(d.tolist()) if np.any(d) else ()
    size = int(message.width), int(message.height)
    source = f"{place} holds a camera that cannot be used"
    if lens and message.distortion_model not in _LENSES:
        raise SourceError(f"{source}: {message.distortion_model}, expected {_LENSES[0]}: {UNDISTORT}")
    try:
        if min(size) < 1:
            raise DatasetError(f"{source}: it has {size[0]}x{size[1]} pixels")
        check_matrix(source, k.reshape(3, 3))
        return camera_of(source, k[[0, 4, 2, 5]].tolist(), size, lens)
    except DatasetError as exc:
        raise SourceError(str(exc)) from exc
