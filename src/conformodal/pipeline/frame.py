"""Checks of images, timestamps and indices of frames, which bring them into one form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import IntArray, UInt8Array
from conformodal.geometry import PinholeCamera

from .errors import OdometryError


def as_image(image: Any, camera: PinholeCamera) -> UInt8Array | str:
    """An image (height, width, 3) in the camera's size, RGB, 8 bits, contiguous; or, as text, why it is none.

    It may be what NumPy makes an array of, such as a Pillow image.
    """
    if image is None:
        return "no image"
    expected = (camera.height, camera.width, 3)
    try:
        found = np.asarray(image)
    except Exception as exc:  # whatever the object raises: it is no image, and the stream goes on
        return f"image is a {type(image).__name__} that is no array ({type(exc).__name__}: {exc})"
    if np.ma.is_masked(image):
        return "image is masked, expected all pixels"
    if found.shape != expected or found.dtype != np.uint8:
        return f"image is {found.dtype} {found.shape}, expected uint8 {expected}"
    return np.ascontiguousarray(found)  # flipped views too: others read its memory


def as_time(timestamp_s: Any, last_s: float | None) -> float:
    """A timestamp in seconds, later than the last one."""
    try:
        found = float(timestamp_s)
    except (TypeError, ValueError, OverflowError):
        raise OdometryError(f"timestamp must be a number of seconds, got {timestamp_s!r}") from None
    if not math.isfinite(found):
        raise OdometryError(f"timestamp must be finite, got {found} s")
    if last_s is not None and not found > last_s:
        raise OdometryError(f"timestamps must increase: {found} s follows {last_s} s")
    return found


def as_frames(frames: npt.ArrayLike, n: int) -> IntArray:
    """Increasing indices (m,) of some of n frames."""
    found = np.asarray(frames)
    if found.ndim != 1 or (found.size and found.dtype.kind not in "iu"):
        raise OdometryError(f"frames must be whole numbers of shape (m,), got {found.dtype} {found.shape}")
    wanted = found.astype(np.int64)
    few = np.array2string(wanted, threshold=8, edgeitems=3, separator=", ")
    if wanted.size and (wanted[0] < 0 or wanted[-1] >= n or (np.diff(wanted) <= 0).any()):
        raise OdometryError(f"frames must increase and lie within 0 and {n - 1}, got {few}")
    return wanted
