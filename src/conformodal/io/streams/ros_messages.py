"""Images and cameras in ROS messages, whoever has read them: rosbags from a file, or rclpy from a topic."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.geometry.lens import AnyCamera
from conformodal.io.cameras import UNDISTORT, Size, camera_of, check_matrix, fisheye_of
from conformodal.io.decoding import decode, to_eight_bits, white_in, white_level
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


def encoding_of(message: Any, place: str = "image") -> str:
    """The encoding of a ``sensor_msgs/Image`` by its name in rosbags-image; a :class:`SourceError` if it has none."""
    encoding: str = message.encoding.strip().lower()  # some drivers write capitals
    encoding = _OF_OPENCV.get(encoding, encoding)
    if encoding not in (readable := rosbags_image().ENCODINGMAP):
        raise SourceError(f"{place}: encoding {message.encoding} is none of {', '.join(readable)}")
    return encoding


def white_of(message: Any) -> int:
    """The level that is shown as white: of the bits that a 16-bit image uses, else 255."""
    if not hasattr(message, "encoding"):
        return white_in(bytes(message.data))
    return white_level(_pixels(message)) if encoding_of(message).endswith("16") else 255


def image_of(message: Any, kind: str, white: int | None = None) -> UInt8Array:
    """The image (height, width, 3) RGB of a ``sensor_msgs/Image`` (:data:`RAW`) or ``CompressedImage`` (`COMPRESSED`).

    `white` is the level of 16-bit images that becomes 255; by default that of the bits that this image uses.

    Raises
    ------
    ValueError
        If its encoding is not known, or its bytes do not make such an image.
    """
    if kind == COMPRESSED:
        return _decompressed(message, white)
    pixels, encoding = _pixels(message), encoding_of(message)
    if pixels.dtype == np.uint16:
        pixels = to_eight_bits(pixels, white or white_level(pixels))
        encoding = encoding.removesuffix("16") + "8"
    try:
        return np.asarray(rosbags_image().convert_color(pixels, encoding, "rgb8"), dtype=np.uint8)
    except cv2.error as exc:  # such as an odd side, where two pixels share a colour
        raise ValueError(f"{message.width}x{message.height} pixels cannot be {message.encoding}") from exc


def _pixels(message: Any) -> AnyArray:
    """The values of a raw image, which rosbags-image takes without padding, and of NV12 and NV21 with colours below."""
    encoding = encoding_of(message)
    bits, _, _, n_values = rosbags_image().ENCODINGMAP[encoding]
    width = message.width * n_values * bits // 8
    height = message.height * 3 // 2 if encoding.startswith("nv") else message.height
    data = np.frombuffer(message.data, dtype=np.uint8)
    step = width if data.size == height * width else message.step  # some drivers count it in pixels, or leave it out
    if data.size != height * step or step < width or not data.size:
        raise ValueError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :width])
    size = {"width": message.width, "height": height, "is_bigendian": message.is_bigendian}
    return np.asarray(rosbags_image().image_to_cvimage(SimpleNamespace(encoding=encoding, data=rows, **size)))


def _decompressed(message: Any, white: int | None) -> UInt8Array:
    image = decode(bytes(message.data), f"{message.format!r} data", white=white)
    if is_swapped(message.format):
        return np.ascontiguousarray(image[..., ::-1])
    mosaic, _, target = message.format.lower().partition(";")
    encoding = mosaic.strip().rstrip("16").rstrip("8") + "8"
    if (
        not mosaic.startswith("bayer")
        or encoding not in rosbags_image().ENCODINGMAP
        or "8" in target.partition("compressed")[2]
    ):
        return image
    return np.asarray(
        rosbags_image().convert_color(np.ascontiguousarray(image[..., 0]), encoding, "rgb8"), dtype=np.uint8
    )


def is_swapped(form: str) -> bool:
    """Whether the file of a ``CompressedImage`` has red for blue: of image_transport, ``; jpeg compressed rgb8``."""
    return "compressed rgb" in form.lower().partition(";")[2]


def is_calibrated(message: Any) -> bool:
    """Whether a ``sensor_msgs/CameraInfo`` gives a camera: drivers without a calibration send zeros."""
    return bool(np.any(_field(message, "K")) or np.any(_field(message, "P")))


def camera_of_info(
    message: Any, place: str, topic: str = "", size: Size | None = None, notes: list[Note] | None = None
) -> AnyCamera:
    """The camera of a ``sensor_msgs/CameraInfo``.

    Parameters
    ----------
    message
        Of ROS 1 or 2. Its window (``roi``) and binning are applied.
    place
        Where it comes from, for messages.
    topic
        Of the images: for rectified ones, as ``image_rect_color``, P is the camera, without distortion, as for others
        whose K and D are zero; else K and D.
    size
        Of the images; the camera is scaled to it.
    notes
        Takes up which matrix was used, and what is unlikely.

    Raises
    ------
    SourceError
        If the camera is not a pinhole or fisheye with a lens that is known, or its numbers are not those of a camera.
    """
    notes = [] if notes is None else notes
    K = _field(message, "K").reshape(3, 3)
    P = _field(message, "P").reshape(3, 4)[:, :3]
    lens: tuple[float, ...] = tuple(_field(message, "D").tolist())
    rectified = re.search(r"(^|[/_])rect(ified)?($|[/_])", topic) is not None
    model = message.distortion_model.strip().lower().replace(" ", "_")
    if rectified and not P.any() and any(lens):
        raise SourceError(f"{place}: P is zero, and {topic} has rectified images, whose camera K and D are not")
    only_p = bool(P.any()) and not K.any() and not any(lens)
    by_p = only_p or (rectified and bool(P.any()))
    matrix = P if by_p else K
    if not matrix.any():
        reason = ", and D, which is not, says that P is of other images" if P.any() else ""
        raise SourceError(f"{place}: the camera is not calibrated: K is zero{reason}")
    fisheye = model in _FISHEYES and not (rectified or by_p)
    lens = lens if not rectified and any(lens) else ()
    if len(lens) > 4 if fisheye else (any(lens[5:]) or bool(lens and model not in _LENSES)):
        raise SourceError(
            f"{place}: lens {model!r} of {len(lens)} numbers, expected {_LENSES[0]} or {_FISHEYES[0]}: {UNDISTORT}"
        )
    roi, whole = message.roi, (int(message.width), int(message.height))
    if whole == (0, 0) and size is not None:  # as drivers without a calibration write it
        whole = size
    window = (int(roi.width), int(roi.height)) if roi.width and roi.height else whole
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    stated = window[0] // binning[0], window[1] // binning[1]
    if min(stated) < 1:
        raise SourceError(f"{place}: gives its camera for {stated[0]}x{stated[1]} pixels, expected sides of at least 1")
    try:
        check_matrix(place, matrix)
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] - roi.x_offset, matrix[1, 2] - roi.y_offset
        pixels = fx / binning[0], fy / binning[1], cx / binning[0], cy / binning[1]
        of, lens = (fisheye_of, (*lens, 0.0, 0.0, 0.0, 0.0)[:4]) if fisheye else (camera_of, lens)
        camera: AnyCamera = of(place, pixels, size or stated, lens, stated=stated, notes=notes)
    except DatasetError as exc:
        raise SourceError(str(exc)) from exc
    how = "K and D" if any(lens) else "K and D, which is zero"
    if by_p:
        how = f"P, {'as K and D are zero' if only_p else 'for rectified images'}, without distortion"
    cut = "" if stated == whole else f", window {window[0]}x{window[1]}, binning {binning[0]}x{binning[1]}"
    notes.append(Note("camera of CameraInfo", f"{place}: {how}{cut}"))
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
