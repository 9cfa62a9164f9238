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

from conformodal.core.arrays import AnyArray, Float32Array, UInt8Array, evenly_spread

from .errors import ImageError

_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
# A small file that claims more pixels than this, and so many per byte, was made to fill the memory.
_FREE_PIXELS, _PIXELS_PER_BYTE = 16_000_000, 20
_ENDS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
_ORIENTATION, _PHOTOMETRIC, _SIDEWAYS = 0x0112, 0x0106, 5
_WHITES = (1023, 4095, 16383, 65535)
WIDEST = _WHITES[-1]
TURNED = "images are turned"
_SAMPLES = 9
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


def sample_wide(paths: list[Path]) -> list[AnyArray]:
    """The numbers of a few evenly spread images of 16 bits; those of 8, or that cannot be read, are passed over."""
    samples = []
    for path in (paths[i] for i in evenly_spread(len(paths), _SAMPLES)):
        with suppress(Exception), _opened(path, "") as image:
            samples.append(_wide(image, path))
    return [wide for wide in samples if wide is not None]


def white_in(content: bytes) -> int:
    """The level that is shown as white in an image file's content: 255 with 8 bits, or where it is not an image."""
    with suppress(Exception), _opened(content, "") as image:
        if (wide := _wide(image, content)) is not None:
            return white_level(wide)
    return 255


def _wide(image: Image.Image, source: Path | bytes) -> AnyArray | None:
    """The numbers (height, width, 1 or 3) of an image of 16 bits, not turned; None for one of 8.

    Pillow keeps only the upper half of the bits of colours.
    """
    tile = getattr(image, "tile", None)
    raw = str(tile[0][3]) if tile else ""
    if not (image.mode.startswith("I") or ";16" in raw or (image.format == "PPM" and str(WIDEST) in raw)):
        return None
    image.load()  # which refuses truncated files
    if image.mode.startswith("I"):
        return np.clip(np.asarray(image).astype(np.int64), 0, WIDEST)[..., None]
    content = np.frombuffer(source if isinstance(source, bytes) else source.read_bytes(), dtype=np.uint8)
    colours = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    if colours is None or colours.dtype != np.uint16 or colours.shape[:2] != (image.height, image.width):
        raise ValueError("its 16-bit colours cannot be decoded")
    return colours[..., 2::-1] if colours.ndim == 3 else colours[..., None]


def common_size(paths: list[Path]) -> tuple[int, int]:
    """The size that most of a few evenly spread images have; else that of the first image that can be read."""
    sizes: Counter[tuple[int, int]] = Counter()
    first: ImageError | None = None
    spread = evenly_spread(len(paths), _SAMPLES).tolist()
    for k, path in enumerate([*(paths[i] for i in spread), *paths]):
        if k >= len(spread) and sizes:
            break
        try:
            sizes[image_size(path)] += 1
        except ImageError as exc:
            first = first or exc
    if not sizes:
        raise first or ImageError("no image was given, expected at least one")
    return sizes.most_common(1)[0][0]


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

    Grey images become RGB; of 16 bits the 10, 12, 14 or 16 that are used are scaled to 8; what is transparent lies on
    black; an image is turned as its EXIF orientation says.

    Parameters
    ----------
    path
        The file.
    size
        Width and height that it must have.

    Raises
    ------
    ImageError
        If the file is missing, truncated or not an image, of another size, holds several pictures or numbers that have
        no range (32 bits, floating point). (Pillow refuses truncated files; some decoders fill the rest with grey in
        silence.)
    """
    return decode(path, str(path), size)


def decode(
    source: Path | bytes, name: str, size: tuple[int, int] | None = None, white: int | None = None
) -> UInt8Array:
    """As :func:`read_image`, of a file or of its content.

    `name` is for people; `white` the level of a 16-bit image that becomes 255, by default of the bits that it uses.
    """
    with _opened(source, name) as image:
        if size is not None:
            _check_size(name, _size(image), size)
        try:
            turned, pixels = _orientation(image), _rgb(image, source, white)
            return pixels if turned == 1 else _upright(pixels, turned)
        except Exception as exc:  # decoders raise whatever damaged bytes lead them to
            raise ImageError(f"{name}: cannot be decoded as an image: {type(exc).__name__}: {exc}") from exc


def _upright(pixels: UInt8Array, stated: int) -> UInt8Array:
    image = Image.fromarray(pixels)
    image.getexif()[_ORIENTATION] = stated
    return np.asarray(ImageOps.exif_transpose(image))


def _opened(source: Path | bytes, name: str) -> Image.Image:
    if isinstance(source, Path) and not os.path.isfile(source):  # a pipe would be waited for
        raise ImageError(f"{name}: {'is not a file' if os.path.exists(source) else 'image is missing'}")
    try:
        image = Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=_FORMATS)
        fault = _fault(image, len(source) if isinstance(source, bytes) else os.path.getsize(source))
    except UnidentifiedImageError as exc:
        raise ImageError(f"{name}: cannot be decoded as an image: it is none of {', '.join(_FORMATS)}") from exc
    except Exception as exc:  # as above
        raise ImageError(f"{name}: cannot be decoded as an image: {exc}") from exc
    if fault:
        image.close()
        raise ImageError(f"{name}: {fault}")
    return image


def _fault(image: Image.Image, n_bytes: int) -> str:
    """Why an image is not read, although it is one."""
    if image.width * image.height > max(_FREE_PIXELS, _PIXELS_PER_BYTE * n_bytes):
        return f"claims {image.width}x{image.height} pixels in {n_bytes} bytes: too many to be an image of a camera"
    n_pictures = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
    if n_pictures != 1:
        return f"holds {n_pictures} pictures, expected one; write each into a file of its own"
    if image.mode == "F" or (image.mode == "I" and image.format not in ("PNG", "PPM")):
        return (
            f"holds numbers without a white level (mode {image.mode}); expected 8 or 16 bits: scale and write it anew"
        )
    return ""


def _rgb(image: Image.Image, source: Path | bytes, white: int | None) -> UInt8Array:
    """Pixels as they are stored."""
    if (wide := _wide(image, source)) is not None:
        eight = to_eight_bits(wide, white or white_level(wide))
        if image.format == "TIFF" and image.tag_v2.get(_PHOTOMETRIC) == 0:  # type: ignore[attr-defined]
            eight = 255 - eight  # its zero is white, which Pillow passes over
        return np.repeat(eight, 3, axis=2) if eight.shape[2] == 1 else eight
    if not image.has_transparency_data:
        return np.asarray(image.convert("RGB"))
    rgba = np.asarray(image.convert("RGBA"))
    return np.asarray((rgba[..., :3].astype(np.uint16) * rgba[..., 3:] + 127) // 255, dtype=np.uint8)


def white_level(wide: AnyArray) -> int:
    """The largest number of the bits that a 16-bit image uses: sensors have 10, 12, 14 or 16."""
    most = int(wide.max(initial=0))
    return next(white for white in _WHITES if most <= white)


def to_eight_bits(wide: AnyArray, white: int) -> UInt8Array:
    """Numbers of a 16-bit image at 8 bits, where `white` becomes 255."""
    return np.asarray((np.minimum(wide.astype(np.int64), white) * 255 + white // 2) // white, dtype=np.uint8)


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
