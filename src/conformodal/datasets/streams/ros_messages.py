"""Images and cameras in ROS messages, whoever has read them: rosbags from a file, or rclpy from a topic."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from conformodal.datasets.cameras import UNDISTORT, Size, camera_of, check_matrix
from conformodal.datasets.decoding import decode, to_eight_bits, white_level
from conformodal.datasets.errors import DatasetError
from conformodal.datasets.reading import Note
from conformodal.poses import PinholeCamera

from .frames import SourceError

RAW, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
# encoding: (bytes and number of values of a pixel, rows in halves of the image's, conversion to RGB or None)
_ENCODINGS: dict[str, tuple[int, int, int, int | None]] = {
    "rgb8": (1, 3, 2, None),
    "bgr8": (1, 3, 2, cv2.COLOR_BGR2RGB),
    "8UC3": (1, 3, 2, cv2.COLOR_BGR2RGB),
    "rgba8": (1, 4, 2, cv2.COLOR_RGBA2RGB),
    "bgra8": (1, 4, 2, cv2.COLOR_BGRA2RGB),
    "mono8": (1, 1, 2, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, 1, 2, cv2.COLOR_GRAY2RGB),
    "rgb16": (2, 3, 2, None),
    "bgr16": (2, 3, 2, cv2.COLOR_BGR2RGB),
    "mono16": (2, 1, 2, cv2.COLOR_GRAY2RGB),
    **{
        f"bayer_{order.lower()}{8 * width}": (width, 1, 2, getattr(cv2, f"COLOR_Bayer{order}2RGB"))
        for order in ("RGGB", "BGGR", "GBRG", "GRBG")
        for width in (1, 2)
    },
    **dict.fromkeys(("yuv422", "uyvy"), (1, 2, 2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (1, 2, 2, cv2.COLOR_YUV2RGB_YUY2)),
    "nv12": (1, 1, 3, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (1, 1, 3, cv2.COLOR_YUV2RGB_NV21),
}
_LENSES = ("plumb_bob", "radtan", "rational_polynomial")  # the last with k4 to k6 zero, as the first


def stamp_s(message: Any) -> float:
    """The time of a message's header, seconds."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)


def check_encoding(encoding: str, place: str) -> None:
    """Refuse an encoding that cannot be decoded, with the list of those that can."""
    if encoding not in _ENCODINGS:
        raise SourceError(f"{place}: encoding {encoding} is none of {', '.join(_ENCODINGS)}")


def white_of(message: Any) -> int:
    """The level that is shown as white: of the bits that a 16-bit image uses, else 255."""
    if getattr(message, "encoding", "") in _ENCODINGS and _ENCODINGS[message.encoding][0] == 2:
        return white_level(_pixels(message))
    return 255


def image_of(message: Any, kind: str, white: int | None = None) -> npt.NDArray[np.uint8]:
    """The image (height, width, 3) RGB of a message.

    Parameters
    ----------
    message
        A ``sensor_msgs/Image``, or a ``sensor_msgs/CompressedImage``.
    kind
        Which of the two, :data:`RAW` or :data:`COMPRESSED`.
    white
        Level of 16-bit images that becomes 255; by default that of the bits that this image uses.

    Raises
    ------
    ValueError
        If its encoding is not known, or its bytes do not make such an image.
    """
    if kind == COMPRESSED:
        return decode(bytes(message.data), f"{message.format} data")
    image = _pixels(message)
    if image.dtype.itemsize == 2:
        image = to_eight_bits(image, white or white_level(image))
    conversion = _ENCODINGS[message.encoding][3]
    found = image if conversion is None else cv2.cvtColor(image.squeeze(), conversion)
    return np.asarray(found, dtype=np.uint8)


def _pixels(message: Any) -> npt.NDArray[Any]:
    """The values (rows, width, n) of a raw image."""
    check_encoding(message.encoding, "image")
    n_bytes, n_values, halves, _ = _ENCODINGS[message.encoding]
    width, height = message.width * n_bytes * n_values, message.height * halves // 2
    data = np.frombuffer(message.data, dtype=np.uint8)
    if data.size != height * message.step or message.step < width or not data.size:
        raise ValueError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = np.ascontiguousarray(data.reshape(height, message.step)[:, :width])
    kind = f"{'>' if message.is_bigendian else '<'}u{n_bytes}"
    return rows.view(kind).reshape(height, message.width, n_values)


def is_rectified(topic: str) -> bool:
    """Whether a topic's images are rectified by its name, as ``image_proc`` names them: ``image_rect_color``."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


def camera_of_info(
    message: Any, place: str, topic: str = "", size: Size | None = None, notes: list[Note] | None = None
) -> PinholeCamera:
    """The camera of a ``sensor_msgs/CameraInfo``, ROS 1 or 2.

    Rectified images have the camera of P and no distortion, raw ones that of K and D. Both are for the sensor's full
    resolution: the window (``roi``) is cut out of it first, then ``binning`` makes its pixels fewer.

    Parameters
    ----------
    message
        Read already.
    place
        Where it comes from, for errors.
    topic
        Of the images.
    size
        Width and height of the images, where they are known; numbers for images of another size are scaled.
    notes
        Takes up which matrix was used, and what is unlikely.

    Raises
    ------
    SourceError
        If the camera is no pinhole with a lens that is known, or its numbers are none of a camera.
    """
    source = f"{place} holds a camera that cannot be used"
    rectified = is_rectified(topic)
    name = "P" if rectified else "K"
    columns = 4 if rectified else 3
    k = np.array(_field(message, name), dtype=np.float64).reshape(3, columns)[:, :3]
    lens = () if rectified else tuple(np.asarray(_field(message, "D"), dtype=np.float64).tolist())
    lens = lens if any(lens) else ()
    lens = lens if any(lens[5:]) else lens[:5]  # a rational lens whose k4 to k6 are zero is none
    if lens and (len(lens) > 5 or message.distortion_model not in _LENSES):
        raise SourceError(f"{source}: {message.distortion_model}, expected {_LENSES[0]}: {UNDISTORT}")
    roi = message.roi
    window = (
        (int(roi.width), int(roi.height)) if roi.width and roi.height else (int(message.width), int(message.height))
    )
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    stated = window[0] // binning[0], window[1] // binning[1]
    try:
        check_matrix(source, k)
        fx, fy, cx, cy = (k[0, 0], k[1, 1], k[0, 2] - roi.x_offset, k[1, 2] - roi.y_offset)
        pixels = fx / binning[0], fy / binning[1], cx / binning[0], cy / binning[1]
        if min(stated) < 1:
            raise DatasetError(f"{source}: it has {stated[0]}x{stated[1]} pixels")
        camera = camera_of(source, pixels, size or stated, lens, stated=stated, notes=notes)
    except DatasetError as exc:
        raise SourceError(str(exc)) from exc
    if notes is not None:
        cut = (
            f", window {window[0]}x{window[1]}, binning {binning[0]}x{binning[1]}"
            if stated != (message.width, message.height)
            else ""
        )
        how = (
            "P, for rectified images, without distortion"
            if rectified
            else f"K and D{'' if lens else ', which is zero'}"
        )
        notes.append(Note("camera of CameraInfo", f"{place}: {how}{cut}"))
    return camera


def _field(message: Any, name: str) -> Any:
    """A field whose name is a capital letter in ROS 1 and a small one in ROS 2."""
    return getattr(message, name if hasattr(message, name) else name.lower())
