"""Images and cameras in ROS messages, whoever has read them: rosbags from a file, or rclpy from a topic."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np

from conformodal.core.arrays import AnyArray, UInt8Array
from conformodal.io.cameras import UNDISTORT, Size, camera_of, check_matrix
from conformodal.io.decoding import decode, to_eight_bits, white_in, white_level
from conformodal.io.errors import DatasetError
from conformodal.io.lenses import AnyCamera, fisheye_of
from conformodal.io.reading import Note

from .frames import SourceError

RAW, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
# encoding: (bytes and number of values of a pixel, rows in halves of the image's, conversion to RGB or None)
_ENCODINGS: dict[str, tuple[int, int, int, int | None]] = {
    "rgb8": (1, 3, 2, None),
    "bgr8": (1, 3, 2, cv2.COLOR_BGR2RGB),
    "8UC3": (1, 3, 2, cv2.COLOR_BGR2RGB),
    "rgba8": (1, 4, 2, cv2.COLOR_RGBA2RGB),
    **dict.fromkeys(("bgra8", "8UC4"), (1, 4, 2, cv2.COLOR_BGRA2RGB)),
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
_LENSES = (
    "plumb_bob",
    "radtan",
    "rational_polynomial",
    "brown_conrady",
    "",
)  # the third with k4 to k6 zero, as the first
_FISHEYES = ("equidistant", "fisheye", "kannala_brandt4")


def stamp_s(message: Any) -> float:
    """The time of a message's header, seconds."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)


def check_encoding(encoding: str, place: str) -> None:
    """Refuse an encoding that cannot be decoded, with the list of those that can."""
    if _known(encoding) not in _ENCODINGS:
        raise SourceError(f"{place}: encoding {encoding} is none of {', '.join(_ENCODINGS)}")


def _known(encoding: str) -> str:
    """An encoding as the list has it: some drivers write capitals."""
    return encoding if encoding in _ENCODINGS else encoding.strip().lower()


def white_of(message: Any) -> int:
    """The level that is shown as white: of the bits that a 16-bit image uses, else 255."""
    if not hasattr(message, "encoding"):
        return white_in(bytes(message.data))
    if _ENCODINGS.get(_known(message.encoding), (1,))[0] == 2:
        return white_level(_pixels(message))
    return 255


def image_of(message: Any, kind: str, white: int | None = None) -> UInt8Array:
    """The image (height, width, 3) RGB of a ``sensor_msgs/Image`` (:data:`RAW`) or ``CompressedImage`` (`COMPRESSED`).

    `white` is the level of 16-bit images that becomes 255; by default that of the bits that this image uses.

    Raises
    ------
    ValueError
        If its encoding is not known, or its bytes do not make such an image.
    """
    if kind == COMPRESSED:
        image = decode(bytes(message.data), f"{message.format!r} data", white=white)
        mosaic, _, target = message.format.lower().partition(";")
        if is_swapped(message.format):
            return np.ascontiguousarray(image[..., ::-1])
        known = _ENCODINGS.get(f"{mosaic.strip().rstrip('16').rstrip('8')}8")
        if not mosaic.startswith("bayer") or known is None or "8" in target.partition("compressed")[2]:
            return image
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(image[..., 0]), known[3] or 0), dtype=np.uint8)
    image = _pixels(message)
    if image.dtype.itemsize == 2:
        image = to_eight_bits(image, white or white_level(image))
    conversion = _ENCODINGS[_known(message.encoding)][3]
    try:
        found = image if conversion is None else cv2.cvtColor(image.squeeze(), conversion)
    except cv2.error as exc:  # such as an odd side, where two pixels share a colour
        raise ValueError(f"{message.width}x{message.height} pixels cannot be {message.encoding}") from exc
    return np.asarray(found, dtype=np.uint8)


def is_swapped(form: str) -> bool:
    """Whether the file of a ``CompressedImage`` has red for blue: of image_transport, ``; jpeg compressed rgb8``."""
    return "compressed rgb" in form.lower().partition(";")[2]


def _pixels(message: Any) -> AnyArray:
    """The values (rows, width, n) of a raw image."""
    check_encoding(message.encoding, "image")
    n_bytes, n_values, halves, _ = _ENCODINGS[_known(message.encoding)]
    width, height = message.width * n_bytes * n_values, message.height * halves // 2
    data = np.frombuffer(message.data, dtype=np.uint8)
    step = width if data.size == height * width else message.step  # some drivers count it in pixels, or leave it out
    if data.size != height * step or step < width or not data.size:
        raise ValueError(f"{data.size} bytes do not make {message.width}x{message.height} pixels {message.encoding}")
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :width])
    kind = f"{'>' if message.is_bigendian else '<'}u{n_bytes}"
    return rows.view(kind).reshape(height, message.width, n_values)


def is_rectified(topic: str) -> bool:
    """Whether a topic's images are rectified by its name, as ``image_rect_color`` of ``image_proc``."""
    return re.search(r"(^|[/_])rect(ified)?($|[/_])", topic) is not None


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
        Of the images: for rectified ones P is the camera, without distortion, as for others whose K and D are zero;
        else K and D.
    size
        Of the images; the camera is scaled to it.
    notes
        Takes up which matrix was used, and what is unlikely.

    Raises
    ------
    SourceError
        If the camera is no pinhole or fisheye with a lens that is known, or its numbers are none of a camera.
    """
    found: list[Note] = []
    lens = tuple(np.asarray(_field(message, "D"), dtype=np.float64).tolist())
    P = np.array(_field(message, "P"), dtype=np.float64).reshape(3, 4)[:, :3]
    rectified, model = is_rectified(topic), message.distortion_model.strip().lower().replace(" ", "_")
    if rectified and not P.any() and any(lens):
        raise SourceError(f"{place}: P is zero, and {topic} has rectified images, whose camera K and D are not")
    k = np.array(_field(message, "K"), dtype=np.float64).reshape(3, 3)
    only_p = bool(P.any()) and not k.any() and not any(lens)
    by_p = only_p or (rectified and P.any())
    k = P if by_p else k
    if not k.any():
        lost = ", and D, which is not, says that P is of other images" if P.any() else ""
        raise SourceError(f"{place}: the camera is not calibrated: K is zero{lost}")
    fisheye = model in _FISHEYES and not (rectified or by_p)
    lens = () if rectified or not (any(lens) or fisheye) else lens
    bad = len(lens) > 4 if fisheye else any(lens[5:]) or bool(lens and model not in _LENSES)
    if bad:
        raise SourceError(
            f"{place}: lens {model!r} of {len(lens)} numbers, expected {_LENSES[0]} or {_FISHEYES[0]}: {UNDISTORT}"
        )
    roi = message.roi
    whole = int(message.width), int(message.height)
    if whole == (0, 0) and size is not None:  # as drivers without a calibration of their own say it
        whole = size
    window = (int(roi.width), int(roi.height)) if roi.width and roi.height else whole
    binning = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    stated = window[0] // binning[0], window[1] // binning[1]
    if min(stated) < 1:
        raise SourceError(f"{place}: gives its camera for {stated[0]}x{stated[1]} pixels, expected sides of at least 1")
    try:
        check_matrix(place, k)
        fx, fy, cx, cy = (k[0, 0], k[1, 1], k[0, 2] - roi.x_offset, k[1, 2] - roi.y_offset)
        pixels = fx / binning[0], fy / binning[1], cx / binning[0], cy / binning[1]
        camera: AnyCamera = (
            fisheye_of(place, pixels, size or stated, (*lens, 0.0, 0.0, 0.0, 0.0)[:4], stated=stated, notes=found)
            if fisheye
            else camera_of(place, pixels, size or stated, lens, stated=stated, notes=found)
        )
    except DatasetError as exc:
        raise SourceError(str(exc)) from exc
    if notes is not None:
        cut = "" if stated == whole else f", window {window[0]}x{window[1]}, binning {binning[0]}x{binning[1]}"
        zero = "" if lens else ", which is zero"
        why = "as K and D are zero" if only_p else "for rectified images"
        how = f"P, {why}, without distortion" if by_p else f"K and D{zero}"
        notes += [*found, Note("camera of CameraInfo", f"{place}: {how}{cut}")]
    return camera


def key_of_info(message: Any) -> str:
    """What a CameraInfo says of the camera, to tell when that changes."""
    values = [np.asarray(_field(message, name)).tolist() for name in "KPD"]
    roi = message.roi
    window = roi.x_offset, roi.y_offset, roi.width, roi.height, message.binning_x, message.binning_y
    return repr((values, message.distortion_model, message.width, message.height, window))


def _field(message: Any, name: str) -> Any:
    """A field whose name is a capital letter in ROS 1 and a small one in ROS 2."""
    return getattr(message, name if hasattr(message, name) else name.lower())
