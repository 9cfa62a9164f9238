"""Cameras that are impossible or unlikely, told by their numbers: those of other images first, then view and lens."""

from __future__ import annotations

from math import atan, degrees, hypot
from pathlib import Path
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.io.errors import DatasetError

UNLIKELY_CAMERA = "camera is unlikely"
UNDISTORT = "undistort the images to a pinhole camera first (such as colmap image_undistorter), and give that camera"
_CANNOT_DEG, _UNLIKELY_DEG = (0.1, 170.0), (3.0, 130.0)  # fields of view
# By how much a principal point is beside the middle, as a share of the image's side: in any way; along the diagonal, as
# those of smaller or larger images are; and at most where images are turned.
_OFF_CENTRE, _OFF_DIAGONAL, _OFF_TURNED, _CENTRED = 0.2, 0.12, 0.1, 0.05
_ALIKE, _UNLIKE = 1.06, 1.25  # scales of both sides; fx and fy
_FOCAL_OFF = 0.02  # a focal length that differs by a larger share is reported
_MAX_BENT, _MAX_SHARE = 10.0, 3.0  # of the distance from the middle; of the image's side, no pixels


class CameraDoubts(NamedTuple):
    """Why a camera cannot be, or is unlikely."""

    impossible: str
    unlikely: list[str]


def doubt_camera(camera: PinholeCamera) -> CameraDoubts:
    """What is wrong with a camera: that of other images explains an impossible view or lens, and is told alone."""
    other = _of_other_images(camera)
    cannot, doubts = _views(camera)
    bent, folds = _lens(camera)
    if other:
        return CameraDoubts(other if cannot or bent else "", [] if cannot or bent else [other])
    if cannot or bent:
        return CameraDoubts(cannot or bent, [])
    if max(_beside(camera)) > _OFF_CENTRE:
        point = f"principal point ({camera.cx:g}, {camera.cy:g})"
        doubts.append(f"{point} is far from the middle of {_pixels(camera)}")
    if not 1 / _UNLIKE < camera.fx / camera.fy < _UNLIKE:
        doubts.append(f"fx = {camera.fx:g} and fy = {camera.fy:g} differ, and cameras have nearly square pixels")
    return CameraDoubts("", doubts + folds)


def doubt_focal(implied_px: float, camera: PinholeCamera) -> str:
    """Whether the focal length that the poses imply is another one than the camera's; else nothing."""
    if abs(implied_px / camera.fx - 1) < _FOCAL_OFF:
        return ""
    return f"the poses imply a focal length of {implied_px:.0f} px where {camera.fx:.0f} px is given: check the camera"


def check_matrix(source: Path | str, k: FloatArray) -> None:
    """Refuse a matrix (3, 3) that is not fx 0 cx, 0 fy cy, 0 0 1."""
    least = max(abs(float(k[0, 0])), 1.0)
    upright = np.allclose(k[2], (0, 0, 1), atol=1e-6, rtol=0) and not np.array_equal(k, np.eye(3))
    if not np.isfinite(k).all() or not upright or abs(k[1, 0]) > 1e-3 * least or abs(k[0, 1]) > 1e-2 * least:
        hint = "; is it transposed?" if np.allclose(k[:2, 2], 0, atol=1e-6) else ""
        raise DatasetError(f"{source}: holds {k.tolist()}, expected rows 'fx 0 cx', '0 fy cy', '0 0 1'{hint}")


def _pixels(camera: PinholeCamera) -> str:
    return f"images of {camera.width}x{camera.height} pixels"


def _beside(camera: PinholeCamera) -> tuple[float, float]:
    """By how much the principal point is beside the middle."""
    return abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)


def _of_other_images(camera: PinholeCamera) -> str:
    """Of which other images a camera seems to be, by its principal point; nothing where it may be of these."""
    wide, high = 2 * camera.cx / camera.width, 2 * camera.cy / camera.height
    point = f"principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of {_pixels(camera)}"
    if max(camera.fx, camera.fy, camera.cx, camera.cy) < _MAX_SHARE < min(camera.width, camera.height):
        numbers = ", ".join(f"{value:g}" for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        return f"fx, fy, cx, cy are {numbers}; are they shares of the image's sides? Give pixels of {_pixels(camera)}"
    turned = max(abs(camera.cx / camera.height - 0.5), abs(camera.cy / camera.width - 0.5))
    if max(_beside(camera)) > _OFF_TURNED and turned < _CENTRED:
        return f"{point}; are the intrinsics those of images turned by 90 degrees ({camera.height}x{camera.width})?"
    if min(wide, high) <= 0 or max(_beside(camera)) < _OFF_DIAGONAL:
        return ""
    if 1 / _ALIKE < wide / high < _ALIKE or min(_beside(camera)) > _OFF_CENTRE:
        return f"{point}; are the intrinsics those of images of about {2 * camera.cx:.0f}x{2 * camera.cy:.0f}?"
    return ""


def _views(camera: PinholeCamera) -> tuple[str, list[str]]:
    """Why the fields of view cannot be, or are unlikely."""
    doubts = []
    for name, sides in (("fx", camera.width / camera.fx), ("fy", camera.height / camera.fy)):
        view = degrees(2 * atan(sides / 2))
        doubt = f"{name} makes a field of view of {view:.3g} degrees with {_pixels(camera)}"
        if not _CANNOT_DEG[0] < view < _CANNOT_DEG[1]:
            return f"{doubt}; expected {_CANNOT_DEG[0]:g} to {_CANNOT_DEG[1]:g}", []
        doubts += [] if _UNLIKELY_DEG[0] < view < _UNLIKELY_DEG[1] else [doubt]
    return "", doubts


def _lens(camera: PinholeCamera) -> tuple[str, list[str]]:
    """Why the distortion cannot be, or is unlikely."""
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r = np.linspace(0, hypot(camera.width / camera.fx, camera.height / camera.fy) / 2, 64)
    bends = np.abs([k1 * r**2, k2 * r**4, k3 * r**6, 3 * p1 * r, 3 * p2 * r]).sum(axis=0)
    if not bends[-1] < _MAX_BENT:
        effect = f"moves the image's corner by {bends[-1]:.3g} of its distance from the middle"
        return f"distortion {camera.distortion} {effect}; of a fisheye, {UNDISTORT}", []
    if (1 + 3 * k1 * r**2 + 5 * k2 * r**4 + 7 * k3 * r**6 <= 0).any():
        return "", [f"distortion {camera.distortion} folds the image over itself before its corner"]
    return "", []
