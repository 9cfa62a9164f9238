"""Cameras from files: what cannot be one is refused, what is unlikely is told."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import atan, degrees, hypot
from pathlib import Path

import numpy as np

from conformodal.geometry import PinholeCamera, PoseError

from .decoding import exif_focal_px
from .errors import DatasetError
from .reading import Note, read_numbers

Size = tuple[int, int]

SCALED = "intrinsics were scaled"
OF_LAYOUT = "the camera is the layout's"

UNDISTORT = "undistort the images to a pinhole camera first (such as colmap image_undistorter), and give that camera"
_TURNED = " (are they turned, perhaps by EXIF?)"
_CANNOT_DEG, _UNLIKELY_DEG = (0.1, 170.0), (3.0, 130.0)  # fields of view
_OFF_CENTRE, _UNLIKE = 0.2, 1.25  # of the image's side; of fx and fy
_SAME_SHAPE, _MOST_PX, MOST_BENT = 0.02, 1e6, 10.0


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
    scaled: list[str] = []
    if stated is not None and tuple(stated) != size:
        if min(stated) < 1:
            raise DatasetError(
                f"{source}: gives its camera for {stated[0]}x{stated[1]} pixels, expected sides of at least 1"
            )
        sx, sy = size[0] / stated[0], size[1] / stated[1]
        if abs(sx / sy - 1) > _SAME_SHAPE:
            raise DatasetError(
                f"{source}: gives its camera for {stated[0]}x{stated[1]} pixels, and the images have "
                f"{size[0]}x{size[1]}, another shape{_TURNED if stated[0] * size[0] == stated[1] * size[1] else ''}; "
                "give the camera of these images"
            )
        fx, fy, cx, cy = fx * sx, fy * sy, cx * sx, cy * sy
        scaled.append(f"intrinsics are scaled from {stated[0]}x{stated[1]} pixels to the images' {size[0]}x{size[1]}")
    try:
        camera = PinholeCamera(fx, fy, cx, cy, *size, lens)
    except PoseError as exc:
        raise DatasetError(f"{source}: {exc}") from exc
    _refuse(source, camera)
    if notes is not None:
        notes += [Note(SCALED, f"{source}: {text}") for text in scaled]
        notes += [Note("camera is unlikely", f"{source}: {text}") for text in _doubts(camera)]
    return camera


def camera_beside(
    folder: Path,
    size: Size,
    default: PinholeCamera | None,
    notes: list[Note] | None = None,
    *,
    focal_px: float | None = None,
    images: Sequence[Path] = (),
) -> PinholeCamera:
    """The camera of ``camera-intrinsics.txt`` (3x3) and ``camera-distortion.txt`` in a folder, else the default.

    The default must be of the images' size, and is noted. Without either, the focal length is `focal_px`, or what EXIF
    says in the first of `images`, with a note.
    """
    path = folder / "camera-intrinsics.txt"
    if focal_px is not None and path.is_file():
        raise DatasetError(f"{path}: gives the camera, and a focal length of {focal_px:g} pixels is given too")
    if not path.is_file():
        if default is not None and (default.width, default.height) == size and focal_px is None:
            if notes is not None:
                where = f"{folder}: its focal length is {default.fx:g} pixels; write another camera into {path.name}"
                notes.append(Note(OF_LAYOUT, where))
            return default
        told = "as given"
        if focal_px is None and images:
            focal_px, told = exif_focal_px(images[0], size)
        if focal_px == 0:  # to begin a fit with
            focal_px, notes = 1.2 * max(size), None
        if focal_px is not None:
            where = f"{folder}: {focal_px:.0f} pixels, {told}; without distortion, and the middle as principal point"
            if notes is not None:
                notes.append(Note("the camera is not calibrated", where))
            middle = size[0] / 2, size[1] / 2
            return camera_of(f"{folder}: focal length", (focal_px, focal_px, *middle), size, notes=notes)
        known = "is known" if default is None else f"is known for {size[0]}x{size[1]} pixels"
        raise DatasetError(
            f"{folder}: no camera {known}; write its 3x3 matrix into {path}, or estimate it from poses by --focal auto"
        )
    k = read_numbers(path)
    lens_path = folder / "camera-distortion.txt"
    lens = tuple(read_numbers(lens_path).tolist()) if lens_path.is_file() else ()
    if k.size not in (4, 9, 16):
        raise DatasetError(f"{path}: holds {k.size} numbers, expected 9 (3x3), 16 (4x4) or fx fy cx cy")
    if k.size > 4:
        matrix = k.reshape(round(k.size**0.5), -1)
        check_matrix(path, matrix[:3, :3])
        k = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return camera_of(f"{path}{f', {lens_path}' if lens else ''}", k, size, lens, notes=notes)


def check_matrix(source: Path | str, k: np.ndarray) -> None:
    """Refuse a matrix (3, 3) that is not fx 0 cx, 0 fy cy, 0 0 1."""
    least = max(abs(float(k[0, 0])), 1.0)
    upright = np.allclose(k[2], (0, 0, 1), atol=1e-6, rtol=0)
    if not np.isfinite(k).all() or not upright or abs(k[1, 0]) > 1e-3 * least or abs(k[0, 1]) > 1e-2 * least:
        turned = np.allclose(k[:, 2], (0, 0, 1), atol=1e-6) and np.isfinite(k).all()
        hint = "; is it transposed?" if turned else ""
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
        raise DatasetError(f"{source}: cx, cy = {camera.cx:g}, {camera.cy:g} is no principal point")
    bent = sum(abs(v) for v in _bends(camera, _corner(camera)))
    if not bent < MOST_BENT:
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
    found = []
    width, height = camera.width, camera.height
    if not (0 <= camera.cx <= width and 0 <= camera.cy <= height):
        whole = (
            f"; they fit images of about {2 * camera.cx:.0f}x{2 * camera.cy:.0f}"
            if min(camera.cx, camera.cy) > 0
            else ""
        )
        found.append(
            f"principal point ({camera.cx:g}, {camera.cy:g}) is outside the images of {width}x{height} pixels{whole}"
        )
    elif max(abs(camera.cx / width - 0.5), abs(camera.cy / height - 0.5)) > _OFF_CENTRE:
        found.append(
            f"principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of images of {width}x{height} "
            f"pixels; are the intrinsics those of images of about {2 * camera.cx:.0f}x{2 * camera.cy:.0f}?"
        )
    if not 1 / _UNLIKE < camera.fx / camera.fy < _UNLIKE:
        found.append(
            f"focal lengths fx = {camera.fx:g} and fy = {camera.fy:g} differ by more than a quarter; cameras have "
            "nearly square pixels"
        )
    for name, view in zip(("fx", "fy"), _views(camera), strict=True):
        if not _UNLIKELY_DEG[0] < view < _UNLIKELY_DEG[1]:
            found.append(f"{name} makes a field of view of {view:.3g} degrees with images of {width}x{height} pixels")
    radii = np.linspace(0, _corner(camera), 64)
    k1, k2, k3 = (_bends(camera, 1.0))[:3]
    if (1 + 3 * k1 * radii**2 + 5 * k2 * radii**4 + 7 * k3 * radii**6 <= 0).any():
        found.append(f"distortion {camera.distortion} folds the image over itself before its corner")
    return found
