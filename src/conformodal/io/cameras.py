"""Cameras from files: what cannot be one is refused, what is unlikely is told."""

from __future__ import annotations

from collections.abc import Iterable
from math import atan, degrees, hypot
from pathlib import Path
from typing import Literal

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import PinholeCamera, PoseError
from conformodal.geometry.lens import Fisheye

from .errors import DatasetError
from .reading import Note, read_numbers

Size = tuple[int, int]

INTRINSICS, DISTORTION = "camera-intrinsics.txt", "camera-distortion.txt"
SCALED, UNDISTORTED = "intrinsics were scaled", "fisheye images are undistorted"
OF_LAYOUT = "the camera is the layout's"

UNDISTORT = "undistort the images to a pinhole camera first (such as colmap image_undistorter), and give that camera"
_CANNOT_DEG, _UNLIKELY_DEG = (0.1, 170.0), (3.0, 130.0)  # fields of view
_OFF_CENTRE, _UNLIKE = 0.2, 1.25  # of the image's side; of fx and fy
_SAME_SHAPE, _MOST_PX, _MOST_BENT = 0.02, 1e6, 10.0
_START_OF_FIT = 1.2  # focal length, of the longer side


def camera_of(
    source: Path | str,
    pixels: Iterable[float],
    size: Size,
    lens: tuple[float, ...] = (),
    *,
    stated: Size | None = None,
    notes: list[Note] | None = None,
) -> PinholeCamera:
    """A camera from fx, fy, cx, cy and the lens distortion of a file (`source` names file and field).

    `stated` is the image size that the file gives its numbers for; they are scaled to `size`. Numbers of no pinhole
    camera raise a DatasetError; unlikely ones are added to `notes`.
    """
    fx, fy, cx, cy = (float(v) for v in pixels)
    lens = lens if any(lens[5:]) else lens[:5]  # a rational lens whose k4 to k6 are zero is none
    told = []
    if stated is not None and tuple(stated) != size:
        given, actual = f"{stated[0]}x{stated[1]}", f"{size[0]}x{size[1]}"
        sx, sy = (size[k] / max(stated[k], 1e-9) for k in (0, 1))
        if min(stated) < 1 or abs(sx / sy - 1) > _SAME_SHAPE:
            raise DatasetError(
                f"{source}: gives its camera for {given} pixels, and the images have {actual}, another shape (are they "
                "turned?); give the camera of these images"
            )
        fx, fy, cx, cy = fx * sx, fy * sy, cx * sx, cy * sy
        told.append(Note(SCALED, f"{source}: intrinsics are scaled from {given} pixels to the images' {actual}"))
    try:
        camera = PinholeCamera(fx, fy, cx, cy, *size, lens if any(lens) else ())
    except PoseError as exc:
        raise DatasetError(f"{source}: {exc}") from exc
    _refuse(source, camera)
    if notes is not None:
        notes += [*told, *(Note("camera is unlikely", f"{source}: {text}") for text in _doubts(camera))]
    return camera


def fisheye_of(
    source: str,
    pixels: Iterable[float],
    size: Size,
    coefficients: tuple[float, ...],
    *,
    stated: Size | None,
    notes: list[Note],
) -> Fisheye:
    """A lens from the numbers of a file and its k1, k2, k3, k4; otherwise as :func:`camera_of`."""
    k1, k2, k3, k4 = (float(k) for k in coefficients)
    lens = Fisheye(camera_of(source, pixels, size, stated=stated, notes=notes), (k1, k2, k3, k4))
    if not np.isfinite(lens.coefficients).all():
        raise DatasetError(f"{source}: fisheye distortion {lens.coefficients} is not finite")
    angles = np.linspace(1e-3, max(lens.corner_rad, 2e-3), 256)
    with np.errstate(over="ignore", invalid="ignore"):
        bent = float(np.abs(lens.radius(angles) / angles - 1).max())
        fold = lens.fold_rad(lens.corner_rad)
    if not bent < _MOST_BENT or fold < np.inf:
        folds = f"; it folds the image over itself {degrees(fold):.0f} degrees from its axis" if fold < np.inf else ""
        raise DatasetError(
            f"{source}: fisheye distortion {lens.coefficients} moves a ray by {bent:.3g} times its distance from the "
            f"middle{folds}, which no lens does"
        )
    whole, left = lens.views_deg()
    target = f"a pinhole camera of fx = {lens.pinhole.fx:g}, fy = {lens.pinhole.fy:g}"
    cut = "; the rest is cut off" if left < whole - 0.1 else ""
    notes.append(Note(UNDISTORTED, f"{source}: to {target}, which keeps {left:.0f} of {whole:.0f} degrees across{cut}"))
    return lens


def camera_beside(folder: Path, size: Size, default: PinholeCamera | None, notes: list[Note]) -> PinholeCamera | None:
    """The camera of ``camera-intrinsics.txt`` (3x3) and ``camera-distortion.txt`` in a folder, else the default.

    The default must be of the images' size, and is noted. None where there is neither.
    """
    path, lens_path = folder / INTRINSICS, folder / DISTORTION
    if not path.is_file():
        if default is None or (default.width, default.height) != size:
            return None
        where = f"{folder}: its focal length is {default.fx:g} pixels; write another camera into {path.name}"
        notes.append(Note(OF_LAYOUT, where))
        return default
    k = read_numbers(path)
    lens = tuple(read_numbers(lens_path).tolist()) if lens_path.is_file() else ()
    if k.size not in (4, 9):
        raise DatasetError(f"{path}: holds {k.size} numbers, expected 9 (3x3) or fx fy cx cy")
    if k.size == 9:
        check_matrix(path, k.reshape(3, 3))
        k = k[[0, 4, 2, 5]]
    return camera_of(f"{path}{f', {lens_path}' if lens else ''}", k, size, lens, notes=notes)


def uncalibrated_camera(
    folder: Path | str, size: Size, focal: float | Literal["auto"] | None, notes: list[Note]
) -> PinholeCamera:
    """The camera of a focal length alone: no distortion, and the middle as principal point; of ``auto``, any to fit."""
    if focal is None:
        raise DatasetError(
            f"{folder}: no camera is known for {size[0]}x{size[1]} pixels; write its 3x3 matrix into {INTRINSICS}, or "
            "estimate it from poses by --focal auto"
        )
    px = _START_OF_FIT * max(size) if focal == "auto" else focal
    if focal != "auto":
        where = f"{folder}: {px:.0f} pixels, as given; without distortion, and the middle as principal point"
        notes.append(Note("the camera is not calibrated", where))
    return camera_of(f"{folder}: focal length", (px, px, size[0] / 2, size[1] / 2), size, notes=notes)


def check_matrix(source: Path | str, k: FloatArray) -> None:
    """Refuse a matrix (3, 3) that is not fx 0 cx, 0 fy cy, 0 0 1."""
    least = max(abs(float(k[0, 0])), 1.0)
    upright = np.allclose(k[2], (0, 0, 1), atol=1e-6, rtol=0)
    if not np.isfinite(k).all() or not upright or abs(k[1, 0]) > 1e-3 * least or abs(k[0, 1]) > 1e-2 * least:
        hint = "; is it transposed?" if np.allclose(k[:, 2], (0, 0, 1), atol=1e-6) else ""
        raise DatasetError(f"{source}: holds {k.tolist()}, expected rows 'fx 0 cx', '0 fy cy', '0 0 1'{hint}")
    if np.array_equal(k, np.eye(3)):
        raise DatasetError(f"{source}: holds the identity matrix, which is no camera")


def _views(camera: PinholeCamera) -> tuple[float, float]:
    sides = (camera.width / camera.fx, camera.height / camera.fy)
    return degrees(2 * atan(sides[0] / 2)), degrees(2 * atan(sides[1] / 2))


def _refuse(source: Path | str, camera: PinholeCamera) -> None:
    for name, view, focal in zip(("fx", "fy"), _views(camera), (camera.fx, camera.fy), strict=True):
        if not _CANNOT_DEG[0] < view < _CANNOT_DEG[1]:
            raise DatasetError(
                f"{source}: {name} = {focal:g} pixels makes a field of view of {view:.3g} degrees with images of "
                f"{camera.width}x{camera.height}; expected {_CANNOT_DEG[0]:g} to {_CANNOT_DEG[1]:g}"
            )
    if max(abs(camera.cx), abs(camera.cy)) > _MOST_PX:
        raise DatasetError(f"{source}: cx, cy = {camera.cx:g}, {camera.cy:g} is not a principal point")
    bent = sum(abs(v) for v in _bends(camera, _corner(camera)))
    if not bent < _MOST_BENT:
        raise DatasetError(
            f"{source}: distortion {camera.distortion} moves the image's corner by {bent:.3g} times its distance from "
            f"the middle, which no lens does; for a fisheye lens, {UNDISTORT}"
        )


def _corner(camera: PinholeCamera) -> float:
    return hypot(camera.width / camera.fx, camera.height / camera.fy) / 2


def _bends(camera: PinholeCamera, r: float) -> tuple[float, ...]:
    """Shares of the radius that k1, k2, k3, p1 and p2 move a point by."""
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5] if camera.distortion else (0.0,) * 5
    return k1 * r**2, k2 * r**4, k3 * r**6, 3 * p1 * r, 3 * p2 * r


def _doubts(camera: PinholeCamera) -> list[str]:
    """What is unlikely."""
    doubts = []
    pixels = f"images of {camera.width}x{camera.height} pixels"
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if off > _OFF_CENTRE:
        place = "outside" if off > 0.5 else "far from the middle of"
        doubts.append(
            f"principal point ({camera.cx:g}, {camera.cy:g}) is {place} {pixels}; are the intrinsics those of images "
            f"of about {2 * camera.cx:.0f}x{2 * camera.cy:.0f}?"
        )
    if not 1 / _UNLIKE < camera.fx / camera.fy < _UNLIKE:
        doubts.append(f"fx = {camera.fx:g} and fy = {camera.fy:g} differ, and cameras have nearly square pixels")
    for name, view in zip(("fx", "fy"), _views(camera), strict=True):
        if not _UNLIKELY_DEG[0] < view < _UNLIKELY_DEG[1]:
            doubts.append(f"{name} makes a field of view of {view:.3g} degrees with {pixels}")
    radii = np.linspace(0, _corner(camera), 64)
    k1, k2, k3 = (_bends(camera, 1.0))[:3]
    if (1 + 3 * k1 * radii**2 + 5 * k2 * radii**4 + 7 * k3 * radii**6 <= 0).any():
        doubts.append(f"distortion {camera.distortion} folds the image over itself before its corner")
    return doubts
