"""Image files to pixels: one way in for all of them."""

from __future__ import annotations

import io
import os
from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from conformodal.core.arrays import Float32Array, UInt8Array, evenly_spread
from conformodal.core.files import foreign_kind, kind_of_file

from .errors import DatasetError, ImageError

_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
_MAX_PIXELS = 64_000_000  # no camera has more, and a small file that claims them would fill the memory
_ENDS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
_ORIENTATION, _PHOTOMETRIC, _SIDEWAYS = 0x0112, 0x0106, 5
_WIDEST, _MIN_WHITE = 65535, 64  # of 16 bits; of 255, in the brightest image of a data set
_SAMPLES = 9
TURNED = "images are turned"
THUMBNAIL = (32, 24)
_BEFORE_BLUR = 128  # pixels across


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, without decoding the image; of one that is turned, after turning."""
    with _opened(path, str(path)) as image:
        return _size(image)


def _size(image: Image.Image) -> tuple[int, int]:
    return (image.height, image.width) if _orientation(image) >= _SIDEWAYS else (image.width, image.height)


def _orientation(image: Image.Image) -> int:
    """EXIF's orientation; 1 for a TIFF, which Pillow turns itself, and where it is damaged."""
    if image.format == "TIFF" or "exif" not in image.info:
        return 1
    with suppress(Exception):  # damaged notes beside the picture say nothing
        stated = int(image.getexif().get(_ORIENTATION, 1))
        return stated if 1 <= stated <= 8 else 1
    return 1


def is_turned(path: Path) -> bool:
    """Whether EXIF says that a picture is shown in another orientation than it is stored in."""
    with suppress(ImageError), _opened(path, "") as image:
        return _orientation(image) != 1
    return False


def common_size(paths: list[Path]) -> tuple[int, int]:
    """The size that most of a few evenly spread images have; else that of the first image that can be read."""
    sizes: Counter[tuple[int, int]] = Counter()
    spread = [paths[i] for i in evenly_spread(len(paths), _SAMPLES)]
    for k, path in enumerate([*spread, *paths]):
        if k >= len(spread) and sizes:
            break
        with suppress(ImageError):
            sizes[image_size(path)] += 1
    return sizes.most_common(1)[0][0] if sizes else image_size(paths[0])  # the latter raises


def refuse_few_bits(paths: list[Path]) -> None:
    """Refuse 16-bit images that use fewer bits, by a few evenly spread ones: read as 8 bits they are black."""
    brightest = []
    for path in (paths[i] for i in evenly_spread(len(paths), _SAMPLES)):
        with suppress(ImageError), _opened(path, "") as image:
            if _is_wide(image):
                brightest.append(int(decode(path, "").max()))
    if brightest and max(brightest) < _MIN_WHITE:
        what = "has 16 bits, and images use less than a quarter of their range"
        raise DatasetError(f"{paths[0]}: {what}; scale all by one factor")


def image_fault(path: Path, size: tuple[int, int]) -> str:
    """Why a file is not an image of a size, or nothing. Decodes it only where its end does not look like one."""
    try:
        _check_size(path, image_size(path), size)
        end = _ENDS.get(path.suffix.lower())
        with path.open("rb") as file:
            file.seek(-min(os.path.getsize(path), 16), os.SEEK_END)
            whole = end is not None and file.read().endswith(end)
        if not whole:
            read_image(path)
    except ImageError as exc:
        return str(exc)
    except OSError as exc:
        return f"{path}: cannot be read: {exc}"
    return ""


def _check_size(name: Path | str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    if size != expected:
        raise ImageError(f"{name}: image is {size[0]}x{size[1]} pixels, the camera's are {expected[0]}x{expected[1]}")


def read_image(path: Path, size: tuple[int, int] | None = None) -> UInt8Array:
    """Decode an image whole, as (height, width, 3) RGB.

    Grey images become RGB; 16 bits become 8; what is transparent lies on black; an image is turned as its EXIF
    orientation says.

    `size` is the width and height that it must have. An :class:`ImageError` if the file is missing, truncated or not an
    image, of another size, holds several pictures or numbers that have no range (32 bits, floating point). (Pillow
    refuses truncated files; some decoders fill the rest with grey in silence.)
    """
    return decode(path, str(path), size)


def decode(source: Path | bytes, name: str, size: tuple[int, int] | None = None) -> UInt8Array:
    """As :func:`read_image`, of a file or of its content; `name` is for people."""
    with _opened(source, name) as image:
        if size is not None:
            _check_size(name, _size(image), size)
        try:
            if (stated := _orientation(image)) == 1:
                return _rgb(image)
            upright = Image.fromarray(_rgb(image))
            upright.getexif()[_ORIENTATION] = stated
            return np.asarray(ImageOps.exif_transpose(upright))
        except Exception as exc:  # decoders raise whatever damaged bytes lead them to
            raise ImageError(f"{name}: cannot be decoded as an image: {type(exc).__name__}: {exc}") from exc


def _opened(source: Path | bytes, name: str) -> Image.Image:
    if isinstance(source, Path) and not os.path.isfile(source):  # a pipe would be waited for
        raise ImageError(f"{name}: {'is not a file' if os.path.exists(source) else 'image is missing'}")
    try:
        image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=_FORMATS)
        fault = _fault(image)
    except UnidentifiedImageError as exc:
        kind = kind_of_file(source) if isinstance(source, Path) else foreign_kind(source)
        what = kind or f"cannot be decoded as an image: it is none of {', '.join(_FORMATS)}"
        raise ImageError(f"{name}: {what}") from exc
    except Exception as exc:  # as above
        raise ImageError(f"{name}: cannot be decoded as an image: {exc}") from exc
    if fault:
        image.close()
        raise ImageError(f"{name}: {fault}")
    return image


def _fault(image: Image.Image) -> str:
    """Why an image is not read, although it is one."""
    if image.width * image.height > _MAX_PIXELS:
        return f"claims {image.width}x{image.height} pixels, expected at most {_MAX_PIXELS}"
    n_pictures = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
    if n_pictures != 1:
        return f"holds {n_pictures} pictures, expected one; write each into a file of its own"
    # Pillow passes over a 16-bit TIFF's tag that zero is white
    inverted = _is_wide(image) and image.format == "TIFF" and image.tag_v2.get(_PHOTOMETRIC) == 0  # type: ignore[attr-defined]
    if inverted or image.mode == "F" or (image.mode == "I" and image.format not in ("PNG", "PPM")):
        return f"holds numbers without a white level (mode {image.mode}); write it anew with 8 bits"
    return ""


def _is_wide(image: Image.Image) -> bool:
    """Whether an image has 16 bits."""
    tile = getattr(image, "tile", None)
    raw = str(tile[0][3]) if tile else ""
    return image.mode.startswith("I") or ";16" in raw or (image.format == "PPM" and str(_WIDEST) in raw)


def _rgb(image: Image.Image) -> UInt8Array:
    """Pixels as they are stored."""
    if image.mode.startswith("I"):
        wide = np.clip(np.asarray(image).astype(np.int64), 0, _WIDEST)
        eight = ((wide * 255 + _WIDEST // 2) // _WIDEST).astype(np.uint8)
        return np.repeat(eight[..., None], 3, axis=2)
    if not image.has_transparency_data:
        return np.asarray(image.convert("RGB"))
    rgba = np.asarray(image.convert("RGBA"))
    return np.asarray((rgba[..., :3].astype(np.uint16) * rgba[..., 3:] + 127) // 255, dtype=np.uint8)


def thumbnail(image: UInt8Array) -> Float32Array:
    """The picture (768,) of an image (height, width[, 3]), RGB or grey: of zero mean and unit length.

    Zero for an image without contrast.
    """
    height, width = image.shape[:2]
    before = (_BEFORE_BLUR, max(1, round(height * _BEFORE_BLUR / width)))
    small = cv2.GaussianBlur(cv2.resize(grey_image(image), before, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    picture = cv2.resize(small, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    picture -= picture.mean()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-6), dtype=np.float32)


def grey_image(image: UInt8Array) -> UInt8Array:
    """An image (height, width[, 3]) as the tracker takes it."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(grey, dtype=np.uint8)
