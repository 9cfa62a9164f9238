"""Cameras from files, impossible ones refused and unlikely ones told; and images brought to another camera."""

from __future__ import annotations

import hashlib
import io
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL import Image

from conformodal.core.files import default_cache_dir, read_file, usable_cache_dir, write_whole
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, PoseError
from conformodal.geometry.lens import filled_share, view_as

from .decoding import decode, image_fault
from .diagnosis.cameras import UNLIKELY_CAMERA, check_matrix, doubt_camera
from .errors import DatasetError, ImageError
from .reading import Note, read_numbers

Size = tuple[int, int]

INTRINSICS, DISTORTION = "camera-intrinsics.txt", "camera-distortion.txt"
SCALED = "intrinsics were scaled"
OF_LAYOUT, OTHER_CAMERA = "the camera is the layout's", "images of another camera are brought to one"

_SAME_SHAPE = 0.02


def camera_of(
    source: Path | str,
    pixels: Iterable[float],
    size: Size,
    lens: tuple[float, ...] = (),
    *,
    stated: Size | None = None,
    notes: list[Note],
) -> PinholeCamera:
    """A camera from fx, fy, cx, cy and the lens distortion of a file (`source` names file and field).

    `stated` is the image size that the file gives its numbers for; they are scaled to `size`. Numbers of no pinhole
    camera raise a DatasetError; unlikely ones are added to `notes`.
    """
    fx, fy, cx, cy = (float(v) for v in pixels)
    lens = lens if any(lens[5:]) else lens[:5]  # a rational lens whose k4 to k6 are zero is none
    if stated is not None and tuple(stated) != size:
        given, actual = f"{stated[0]}x{stated[1]}", f"{size[0]}x{size[1]}"
        sx, sy = (size[k] / max(stated[k], 1e-9) for k in (0, 1))
        if min(stated) < 1 or abs(sx / sy - 1) > _SAME_SHAPE:
            what = f"camera is for {given} pixels, and the images have {actual}, another shape"
            raise DatasetError(f"{source}: {what}; give the camera of these images")
        fx, fy, cx, cy = fx * sx, fy * sy, (cx + 0.5) * sx - 0.5, (cy + 0.5) * sy - 0.5  # pixels' centres are whole
        notes.append(Note(SCALED, f"{source}: intrinsics are scaled from {given} pixels to the images' {actual}"))
    try:
        camera = PinholeCamera(fx, fy, cx, cy, *size, lens if any(lens) else ())
    except PoseError as exc:
        raise DatasetError(f"{source}: {exc}") from exc
    doubts = doubt_camera(camera)
    if doubts.impossible:
        raise DatasetError(f"{source}: {doubts.impossible}")
    notes += [Note(UNLIKELY_CAMERA, f"{source}: {doubt}") for doubt in doubts.unlikely]
    return camera


def camera_beside(folder: Path, size: Size, default: PinholeCamera | None, notes: list[Note]) -> PinholeCamera | None:
    """The camera of ``camera-intrinsics.txt`` (3x3) and ``camera-distortion.txt`` in a folder, else the default.

    The default must be of the images' size, and is noted. None where there is neither. `folder` may be the former file.
    """
    path = folder if folder.is_file() else folder / INTRINSICS
    lens_path = path.with_name(DISTORTION)
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


def uncalibrated_camera(folder: Path | str, size: Size, focal: float | None, notes: list[Note]) -> PinholeCamera:
    """The camera of a focal length in pixels alone: no distortion, and the middle as principal point."""
    if focal is None:
        what = f"no camera is known for {size[0]}x{size[1]} pixels"
        raise DatasetError(f"{folder}: {what}; write its 3x3 matrix into {INTRINSICS}, or give --focal")
    where = f"{folder}: focal length of {focal:.0f} pixels; without distortion, and the middle as principal point"
    notes.append(Note("the camera is not calibrated", where))
    return camera_of(f"{folder}: focal length", (focal, focal, size[0] / 2, size[1] / 2), size, notes=notes)


def undistort_to(
    images: list[Path], cameras: list[PinholeCamera], target: PinholeCamera, notes: list[Note]
) -> list[Path]:
    """Images as the target camera sees them: files of the same names in the cache where they differ.

    They are made where they are missing or damaged. An image that cannot be read, or has another size than its
    camera's, stays where it is: it is no frame anyway. `notes` takes up cameras that are others than the target, with
    how much of its view their images fill.
    """
    for camera, count in Counter(cameras).items():
        if camera != target:
            notes.append(Note(OTHER_CAMERA, f"{counted(count, 'image')} of {describe_change(camera, target)}"))
    try:
        place = usable_cache_dir() / "undistorted"
    except OSError as exc:
        raise DatasetError(f"{default_cache_dir()}: cannot be written: {exc.strerror}; set CONFORMODAL_CACHE") from exc
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(lambda image, camera: _undistorted(image, camera, target, place), images, cameras))


def _undistorted(image: Path, camera: PinholeCamera, target: PinholeCamera, place: Path) -> Path:
    if camera == target:
        return image
    try:
        content = read_file(image)
        digest = hashlib.sha256(f"{camera} {target} ".encode() + content).hexdigest()
        made = place / digest[:2] / digest / f"{image.stem}.png"
        if made.is_file() and not image_fault(made, (target.width, target.height)):
            return made
        pixels = decode(content, str(image), (camera.width, camera.height))
    except (OSError, ImageError):
        return image
    encoded = io.BytesIO()
    Image.fromarray(view_as(pixels, camera, target)).save(encoded, "PNG", compress_level=1)
    try:
        write_whole(made, encoded.getvalue())
    except OSError as exc:
        raise DatasetError(f"{place}: cannot be written: {exc.strerror}; set CONFORMODAL_CACHE") from exc
    return made


def describe_change(camera: PinholeCamera, target: PinholeCamera) -> str:
    """From which camera to which images are brought, and how much of the view there is in them."""
    return (
        f"fx = {camera.fx:g}, {camera.width}x{camera.height} as of fx = {target.fx:g}, {target.width}x{target.height}; "
        f"they fill {100 * filled_share(camera, target):.0f} % of its view"
    )
