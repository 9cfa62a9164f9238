"""Images that are brought to one camera when they are read: of fisheye lenses, of several cameras, of 16 bits.

What is made is kept as files in the cache: the rest of the program knows one camera and 8 bits alone.
"""

from __future__ import annotations

import hashlib
import io
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

from PIL import Image

from conformodal.core.files import default_cache_dir, write_whole
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import AnyCamera, filled_share, pinhole_of, view_as

from .decoding import decode, image_fault
from .errors import DatasetError, ImageError
from .reading import Note
from .recording import Recording

OTHER_CAMERA = "images of another camera are brought to one"


def undistort_to(
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
    with ThreadPoolExecutor(max_workers=2) as pool:
        return list(pool.map(partial(_undistort_to, target=target, white=white), images, cameras))


def _undistort_to(image: Path, camera: AnyCamera, *, target: PinholeCamera, white: int | None) -> Path:
    if camera == target and white is None:
        return image
    pinhole, place = pinhole_of(camera), default_cache_dir() / "undistorted"
    try:
        content = image.read_bytes()
        digest = hashlib.sha256(f"{camera} {target} {white} ".encode() + content).hexdigest()
        made = place / digest[:2] / digest / f"{image.stem}.png"
        if made.is_file() and not image_fault(made, (target.width, target.height)):
            return made
        pixels = decode(content, str(image), (pinhole.width, pinhole.height), white)
    except (OSError, ImageError):
        return image
    encoded = io.BytesIO()
    Image.fromarray(view_as(pixels, camera, target)).save(encoded, "PNG", compress_level=1)
    try:
        write_whole(made, encoded.getvalue())
    except OSError as exc:
        raise DatasetError(
            f"{place}: images cannot be cached there: {exc.strerror}; CONFORMODAL_CACHE names another folder"
        ) from exc
    return made


def describe_change(camera: PinholeCamera, target: PinholeCamera) -> str:
    """From which camera to which images are brought, and how much of the view there is in them."""
    return (
        f"fx = {camera.fx:g}, {camera.width}x{camera.height} as of fx = {target.fx:g}, {target.width}x{target.height}; "
        f"they fill {100 * filled_share(camera, target):.0f} % of its view"
    )


def as_camera(sequence: Recording, camera: PinholeCamera) -> Recording:
    """The sequence as another camera would have seen it, with a note of it.

    Examples
    --------
    ``as_camera(read_recording(folder), model.camera)`` are images that a model can answer which was trained with
    another camera. What this camera does not show is black.
    """
    notes: list[Note] = []
    images = undistort_to(list(sequence.image_paths), [sequence.camera] * len(sequence), camera, None, notes)
    return replace(sequence, image_paths=tuple(images), camera=camera, notes=(*sequence.notes, *notes))
