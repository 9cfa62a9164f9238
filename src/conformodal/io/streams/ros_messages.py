"""Images and cameras in ROS messages, whoever has read them: rosbags from a file, or rclpy from a topic."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import Size, camera_of
from conformodal.io.decoding import decode
from conformodal.io.diagnosis.cameras import UNDISTORT, check_matrix
from conformodal.io.errors import DatasetError
from conformodal.io.reading import Note

from .frames import SourceError

RAW, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_OF_OPENCV = {"8uc1": "mono8", "8uc3": "bgr8", "8uc4": "bgra8"}  # as cv_bridge takes them
# the third with k4 to k6 zero, as the first
_LENSES = ("plumb_bob", "radtan", "rational_polynomial", "brown_conrady", "")
_FISHEYES = ("equidistant", "fisheye", "kannala_brandt4")


def rosbags_image() -> Any:
    """The module that decodes raw images, or an error that names the extra."""
    with require_extra("ros", "a ROS image"):
        from rosbags.image import image  # noqa: PLC0415 - an extra
    return image


def stamp_s(message: Any) -> float:
    """The time of a message's header, seconds."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)


def image_of(message: Any, kind: str) -> UInt8Array:
    """The image (height, width, 3) RGB of a ``sensor_msgs/Image`` (:data:`RAW`) or ``CompressedImage`` (`COMPRESSED`).

    A DatasetError where its encoding is not read, or its bytes do not make such an image.
    """
    if kind == COMPRESSED:
        encoding, _, stored = message.format.lower().partition(";")
        if "16" in encoding or (encoding.startswith("bayer") and "8" not in stored.partition("compressed")[2]):
            raise SourceError(f"images are {message.format!r}, expected 8 bits, grey or in colours; convert them")
        image = decode(bytes(message.data), f"{message.format!r} data")
        # image_transport may store red in the place of blue, and says so
        return np.ascontiguousarray(image[..., ::-1]) if "compressed rgb" in stored else image
    encoding = message.encoding.strip().lower()  # some drivers write capitals
    encoding = _OF_OPENCV.get(encoding, encoding)
    formats = {
        name: values for name, values in rosbags_image().ENCODINGMAP.items() if name[:2] != "nv" and values[0] == 8
    }
    if encoding not in formats:
        raise SourceError(f"encoding {message.encoding} is none of {', '.join(formats)}; convert the images")
    n_values = formats[encoding][3]
    width, data = message.width * n_values, np.frombuffer(message.data, dtype=np.uint8)
    step = width if data.size == message.height * width else message.step  # some drivers leave it out
    if data.size != message.height * step or step < width or not data.size:
        raise SourceError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = data.reshape(message.height, step)[:, :width]  # which may be padded
    pixels = np.ascontiguousarray(rows.reshape(message.height, message.width, n_values))
    try:
        converted = rosbags_image().convert_color(pixels[..., 0] if n_values == 1 else pixels, encoding, "rgb8")
    except cv2.error as exc:  # such as an odd side, where two pixels share a colour
        raise SourceError(f"{message.width}x{message.height} pixels cannot be {message.encoding}") from exc
    return np.asarray(converted, dtype=np.uint8)


def is_calibrated(message: Any) -> bool:
    """Whether a ``sensor_msgs/CameraInfo`` gives a camera: drivers without a calibration send zeros."""
    return bool(np.any(_field(message, "K")) or np.any(_field(message, "P")))


def camera_of_info(
    message: Any, place: str, topic: str = "", size: Size | None = None, notes: list[Note] | None = None
) -> PinholeCamera:
    """The camera of a ``sensor_msgs/CameraInfo`` of ROS 1 or 2, scaled to the `size` of the images.

    Its window (``roi``) and binning are applied. For the topics of rectified images, as ``image_rect_color``, P is the
    camera, without distortion, as for others whose K and D are zero; else K and D. `notes` takes up which was used.
    """
    notes = [] if notes is None else notes
    K, P = _field(message, "K").reshape(3, 3), _field(message, "P").reshape(3, 4)[:, :3]
    lens = tuple(_field(message, "D").tolist())
    model = message.distortion_model.strip().lower().replace(" ", "_")
    rectified = re.search(r"(^|[/_])rect(ified)?($|[/_])", topic) is not None
    by_p = bool(P.any()) and (rectified or not (K.any() or any(lens)))
    matrix = P if by_p else K
    if not matrix.any() or (rectified and not by_p and any(lens)):
        raise SourceError(f"{place}: {'P' if rectified else 'K'} is zero: the camera of these images is not calibrated")
    lens = () if rectified or by_p or not any(lens) else lens
    fisheye = model in _FISHEYES and not (rectified or by_p)  # without coefficients, too, it is not a pinhole camera
    if fisheye or any(lens[5:]) or (lens and model not in _LENSES):
        raise SourceError(f"{place}: lens {model!r} of {len(lens)} numbers, expected {_LENSES[0]}: {UNDISTORT}")
    roi, binning = message.roi, (max(int(message.binning_x), 1), max(int(message.binning_y), 1))
    window = (roi.width, roi.height) if roi.width and roi.height else (message.width, message.height)
    stated = int(window[0]) // binning[0], int(window[1]) // binning[1]
    try:
        check_matrix(place, matrix)
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] - roi.x_offset, matrix[1, 2] - roi.y_offset
        pixels = fx / binning[0], fy / binning[1], cx / binning[0], cy / binning[1]
        camera = camera_of(place, pixels, size or stated, lens, stated=stated, notes=notes)
    except DatasetError as exc:
        raise SourceError(str(exc)) from exc
    notes.append(Note("camera of CameraInfo", f"{place}: {'P, without distortion' if by_p else 'K and D'}"))
    return camera


def key_of_info(message: Any) -> str:
    """What a CameraInfo says of the camera, to tell when that changes."""
    roi = message.roi
    window = roi.x_offset, roi.y_offset, roi.width, roi.height, message.binning_x, message.binning_y
    values = [_field(message, name).tolist() for name in "KPD"]
    return repr((values, message.distortion_model, message.width, message.height, window))


def _field(message: Any, name: str) -> AnyArray:
    """Numbers of a field whose name is a capital letter in ROS 1 and a small one in ROS 2."""
    return np.asarray(getattr(message, name if hasattr(message, name) else name.lower()), dtype=np.float64)
