"""Images that are brought to one camera when they are read: of fisheye lenses, of several cameras, of 16 bits.

What is made is kept as files in the cache: the rest of the program knows one camera and 8 bits alone. A fisheye lens
(Kannala and Brandt 2006, as OpenCV has it) sends a ray at the angle t from the axis to the radius
t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), in units of the focal length.
"""

from __future__ import annotations

import hashlib
import io
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import atan, degrees, hypot
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image

from conformodal.core.arrays import AnyArray, Float32Array, FloatArray
from conformodal.core.files import default_cache_dir, write_whole
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera

from .cameras import MOST_BENT, Size, camera_of
from .decoding import SIDEWAYS, decode, image_fault, orientation
from .errors import DatasetError, ImageError
from .reading import Note
from .recording import Recording

UNDISTORTED = "fisheye images are undistorted"
AS_STORED = "images are read as they are stored"
OTHER_CAMERA = "images of another camera are brought to one"
_WIDEST_RAD = np.pi  # no lens sees more than all around
_STEPS = 4096
_SHRINK = 1.5  # finer images than so many times are made coarser first
_undistort_points = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # its name before OpenCV 5
_PRECISELY = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)


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


AnyCamera: TypeAlias = PinholeCamera | Fisheye


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


def on_plane(camera: PinholeCamera, pixels: FloatArray) -> FloatArray:
    """Where rays through pixels (n, 2) as they are on the image meet the plane at depth 1."""
    if not camera.distortion:
        return camera.on_plane(pixels)
    lens = np.array(camera.distortion)
    found = _undistort_points(pixels[:, None], camera.matrix, lens, R=None, P=None, criteria=_PRECISELY)
    return np.asarray(found).reshape(-1, 2)


@lru_cache(maxsize=16)
def _maps(source: AnyCamera, target: PinholeCamera) -> tuple[Float32Array, Float32Array]:
    """Where in an image of a source the pixels of the target are, x and y; -1 where it does not see them."""
    grid = np.indices((target.height, target.width))[::-1].reshape(2, -1).T.astype(np.float64)
    plane, pinhole = on_plane(target, grid), source.pinhole if isinstance(source, Fisheye) else source
    if isinstance(source, Fisheye):
        lens = np.array(source.coefficients)
        found = cv2.fisheye.distortPoints(plane[:, None], pinhole.matrix, lens).reshape(-1, 2)
        angles = np.linspace(0, np.pi / 2, _STEPS)
        folds = np.flatnonzero(np.diff(source.radius(angles)) <= 0)
        widest = np.tan(angles[folds[0]]) if folds.size else np.inf
    else:
        rays = np.column_stack((plane, np.ones(len(plane))))
        found = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), source.matrix, np.array(source.distortion))[0][:, 0]
        corners = np.array([[x, y] for x in (0.0, source.width - 1) for y in (0.0, source.height - 1)])
        widest = np.linalg.norm(on_plane(source, corners), axis=1).max()  # beyond, a lens may fold into the image again
    found[~(np.linalg.norm(plane, axis=1) <= 1.05 * widest) | ~np.isfinite(found).all(axis=1)] = -1
    x, y = np.clip(found, -1e6, 1e6).T.reshape(2, target.height, target.width).astype(np.float32)
    return x, y


def brought(
    images: list[Path], cameras: list[AnyCamera], target: PinholeCamera, white: int | None, notes: list[Note]
) -> list[Path]:
    """Images as the target camera sees them, at 8 bits: files of the same names in the cache where they differ.

    They are made where they are missing or damaged. An image that cannot be read, or has another size than its
    camera's, stays where it is: it is no frame anyway. `white` is the level of 16-bit images that becomes 255; None for
    8 bits. `notes` takes up cameras that are others than the target, with how much of its view their images fill.
    """
    for camera, count in Counter(cameras).items():
        if isinstance(camera, PinholeCamera) and camera != target:
            notes.append(Note(OTHER_CAMERA, f"{counted(count, 'image')} of {describe_change(camera, target)}"))
    place = default_cache_dir() / "undistorted"
    try:
        with ThreadPoolExecutor(max_workers=2) as pool:
            return list(pool.map(partial(_brought, place=place, target=target, white=white), images, cameras))
    except OSError as exc:
        raise DatasetError(
            f"{place}: undistorted images cannot be kept there: {exc.strerror}; CONFORMODAL_CACHE names another folder"
        ) from exc


def _brought(image: Path, camera: AnyCamera, *, place: Path, target: PinholeCamera, white: int | None) -> Path:
    if camera == target and white is None:
        return image
    own = camera.pinhole if isinstance(camera, Fisheye) else camera

    def make(content: bytes) -> AnyArray:
        return seen_by(decode(content, str(image), (own.width, own.height), white), camera, target)

    return _cached(image, place, f"{camera} {target} {white} ", (target.width, target.height), make)


def as_stored(images: list[Path], wide: Iterable[bool | None], whose: str, notes: list[Note]) -> list[Path]:
    """Images that EXIF turns, as they are stored: files in the cache; any other image itself.

    `wide` is whether a camera's images are wider than high, None if that is not known; of an image that EXIF turns by a
    quarter, it tells whether the camera is that of the image as it is stored, or after.
    """
    found = [_as_stored(image, its) for image, its in zip(images, wide, strict=True)]
    if turned := [image for image, stored in zip(images, found, strict=True) if image != stored]:
        where = f"{turned[0]}: EXIF turns it, and {whose}'s poses and cameras are of images as they are stored"
        notes.append(Note(AS_STORED, f"{where}; {counted(len(turned), 'image')} read so"))
    return found


def _as_stored(image: Path, wide: bool | None) -> Path:
    turned, (width, height) = orientation(image)
    if turned == 1 or (turned >= SIDEWAYS and width != height and wide not in (None, width > height)):
        return image
    make = partial(decode, name=str(image), turn=False)
    return _cached(image, default_cache_dir() / "undistorted", "as stored ", (width, height), make)


def _cached(image: Path, place: Path, key: str, size: Size, make: Callable[[bytes], AnyArray]) -> Path:
    """A file in the cache with what is made of an image's content; the image itself where it cannot be read."""
    try:
        content = image.read_bytes()
    except OSError:
        return image
    digest = hashlib.sha256(key.encode() + content).hexdigest()
    made = place / digest[:2] / digest / f"{image.stem}.png"
    if made.is_file() and not image_fault(made, size):
        return made
    try:
        pixels = make(content)
    except ImageError:
        return image
    written = io.BytesIO()
    Image.fromarray(pixels).save(written, "PNG", compress_level=1)
    write_whole(made, written.getvalue())
    return made


def describe_change(camera: PinholeCamera, target: PinholeCamera) -> str:
    """From which camera to which images are brought, and how much of the view there is in them."""
    x, y = _maps(camera, target)
    inside = (x >= 0) & (x <= camera.width - 1) & (y >= 0) & (y <= camera.height - 1)
    return (
        f"fx = {camera.fx:g}, {camera.width}x{camera.height} as of fx = {target.fx:g}, {target.width}x{target.height}; "
        f"they fill {100 * inside.mean():.0f} % of its view"
    )


def seen_by(pixels: AnyArray, camera: AnyCamera, target: PinholeCamera) -> AnyArray:
    """An image as another camera would have seen it; unchanged if it is not of its own camera's size."""
    own = camera.pinhole if isinstance(camera, Fisheye) else camera
    if camera == target or pixels.shape[:2] != (own.height, own.width):
        return pixels
    x, y = _maps(camera, target)
    finer = own.fx / target.fx
    if finer > _SHRINK:  # what a pixel covers is averaged, not one point of it taken
        pixels = cv2.resize(pixels, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)
        scale = pixels.shape[1] / own.width, pixels.shape[0] / own.height
        x, y = (x + 0.5) * scale[0] - 0.5, (y + 0.5) * scale[1] - 0.5
    return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def as_camera(sequence: Recording, camera: PinholeCamera) -> Recording:
    """The sequence as another camera would have seen it, with a note of it.

    Examples
    --------
    ``as_camera(read_recording(folder), model.camera)`` are images that a model can answer which was trained with
    another camera. What this camera does not show is black.
    """
    notes: list[Note] = []
    images = brought(list(sequence.image_paths), [sequence.camera] * len(sequence), camera, None, notes)
    return replace(sequence, image_paths=tuple(images), camera=camera, notes=(*sequence.notes, *notes))
