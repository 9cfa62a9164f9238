"""Fisheye lenses (Kannala and Brandt 2006, as OpenCV has it): their images are undistorted once, when they are read.

The lens sends a ray at the angle t from the axis to the radius t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), in units of
the focal length. Undistorted images are files in the cache: the rest of the program knows pinhole cameras alone.
"""

from __future__ import annotations

import hashlib
import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from math import atan, degrees, hypot
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from conformodal.core.arrays import FloatArray
from conformodal.core.caching import default_cache_dir
from conformodal.core.files import write_whole
from conformodal.poses import PinholeCamera

from .cameras import MOST_BENT, Size, camera_of
from .decoding import decode, image_fault
from .errors import DatasetError, ImageError
from .reading import Note

UNDISTORTED = "fisheye images are undistorted"
_WIDEST_RAD = np.pi  # no lens sees more than all around
_STEPS = 4096


@dataclass(frozen=True)
class Fisheye:
    """A fisheye lens, and the pinhole camera that its images are undistorted to.

    Attributes
    ----------
    pinhole
        Of the same size, focal lengths and principal point.
    coefficients
        k1, k2, k3, k4.
    """

    pinhole: PinholeCamera
    coefficients: tuple[float, float, float, float]

    def radius(self, angle_rad: FloatArray) -> FloatArray:
        """Where rays (n,) at an angle from the axis fall, in focal lengths from the principal point."""
        even = np.polynomial.polynomial.polyval(angle_rad**2, (1.0, *self.coefficients))
        return np.asarray(angle_rad * even)

    def maps(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Where in the lens's image the pixels of the undistorted one are, x and y."""
        size, matrix = (self.pinhole.width, self.pinhole.height), self.pinhole.matrix
        lens = np.array(self.coefficients)
        x, y = cv2.fisheye.initUndistortRectifyMap(matrix, lens, np.eye(3), matrix, size, cv2.CV_32FC1)
        return np.asarray(x), np.asarray(y)


def fisheye_of(
    source: str,
    pixels: tuple[float, ...],
    size: Size,
    coefficients: tuple[float, ...],
    *,
    stated: Size | None,
    notes: list[Note],
) -> Fisheye:
    """A lens from the numbers of a file and its k1, k2, k3, k4; otherwise as :func:`~.cameras.camera_of`."""
    k1, k2, k3, k4 = (float(k) for k in coefficients)
    pinhole = camera_of(source, pixels, size, stated=stated, notes=notes)
    lens = Fisheye(pinhole, (k1, k2, k3, k4))
    if not np.isfinite(lens.coefficients).all():
        raise DatasetError(f"{source}: fisheye distortion {lens.coefficients} is not finite")
    corners = [hypot(x / pinhole.fx, y / pinhole.fy) for x in _sides(pinhole)[:2] for y in _sides(pinhole)[2:]]
    angles = np.linspace(0, atan(max(corners)), _STEPS)
    with np.errstate(over="ignore", invalid="ignore"):
        radii = lens.radius(angles)
        bent = float(np.abs(radii[1:] / angles[1:] - 1).max())
    if not bent < MOST_BENT:
        raise DatasetError(
            f"{source}: fisheye distortion {lens.coefficients} moves a ray by {bent:.3g} times its distance from the "
            "middle, which no lens does"
        )
    if not (np.diff(radii) > 0).all():
        raise DatasetError(
            f"{source}: fisheye distortion {lens.coefficients} folds the image over itself "
            f"{degrees(float(angles[np.argmax(np.diff(radii) <= 0)])):.0f} degrees from its axis, which no lens does"
        )
    notes.append(Note(UNDISTORTED, f"{source}: {_views(lens)}"))
    return lens


def _sides(pinhole: PinholeCamera) -> tuple[float, float, float, float]:
    """Pixels from the principal point to the left, right, upper and lower side."""
    return pinhole.cx, pinhole.width - pinhole.cx, pinhole.cy, pinhole.height - pinhole.cy


def _views(lens: Fisheye) -> str:
    """What the lens sees across the image's width, and what is left of it."""
    pinhole = lens.pinhole
    angles = np.linspace(0, _WIDEST_RAD, _STEPS)
    radii = lens.radius(angles)
    folds = np.flatnonzero(np.diff(radii) <= 0)
    until = int(folds[0]) + 1 if folds.size else _STEPS
    seen = left = 0.0
    for side in _sides(pinhole)[:2]:
        seen += float(np.interp(side / pinhole.fx, radii[:until], angles[:until]))
        left += atan(side / pinhole.fx)
    cut = "; the rest is cut off" if left < seen - 1e-3 else ""
    return (
        f"to a pinhole camera of fx = {pinhole.fx:g}, fy = {pinhole.fy:g}, which keeps {degrees(left):.0f} of "
        f"{degrees(seen):.0f} degrees across{cut}"
    )


def undistorted(images: list[Path], lens: Fisheye) -> list[Path]:
    """Undistorted images, files of the same names in the cache, made where they are missing or damaged.

    An image that cannot be read, or has another size than the camera's, stays where it is: it is no frame anyway.
    """
    place = default_cache_dir() / "undistorted"
    try:
        with ThreadPoolExecutor(max_workers=2) as pool:
            return list(pool.map(partial(_undistorted, place=place, lens=lens, maps=lens.maps()), images))
    except OSError as exc:
        raise DatasetError(
            f"{place}: undistorted images cannot be kept there: {exc.strerror}; CONFORMODAL_CACHE names another folder"
        ) from exc


def _undistorted(
    image: Path, *, place: Path, lens: Fisheye, maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
) -> Path:
    try:
        content = image.read_bytes()
    except OSError:
        return image
    digest = hashlib.sha256(f"{lens.pinhole} {lens.coefficients} ".encode() + content).hexdigest()
    target = place / digest[:2] / digest / f"{image.stem}.png"
    size = lens.pinhole.width, lens.pinhole.height
    if target.is_file() and not image_fault(target, size):
        return target
    try:
        pixels = decode(content, str(image), size)
    except ImageError:
        return image
    flat = cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    written = io.BytesIO()
    Image.fromarray(flat).save(written, "PNG", compress_level=1)
    write_whole(target, written.getvalue())
    return target
