"""Image files to pixels: one way in for all of them."""

from __future__ import annotations

import io
import os
import re
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from math import hypot
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from conformodal.core.arrays import AnyArray, Float32Array, UInt8Array, evenly_spread

from .errors import ImageError

_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
# A small file that claims more pixels than this, and so many a byte, was made to fill the memory.
_FREE_PIXELS, _PIXELS_A_BYTE, _MOST_PIXELS = 16_000_000, 20, 400_000_000
_ENDS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
_ORIENTATION, _PHOTOMETRIC = 0x0112, 0x0106
_WHITES = (1023, 4095, 16383, 65535)
WIDEST = _WHITES[-1]
TURNED, SCALED_BITS, FLAT = "images are turned", "images use fewer than 16 bits", "images have little contrast"
SIDEWAYS = 5
_EXIF, _FOCAL_MM, _FOCAL_35_MM = 0x8769, 0x920A, 0xA405
_PLANE_RESOLUTION, _PLANE_UNIT, _EXIF_WIDTH, _EXIF_HEIGHT = 0xA20E, 0xA210, 0xA002, 0xA003
_UNIT_MM, _DIAGONAL_MM = {2: 25.4, 3: 10.0, 4: 1.0}, hypot(36, 24)
_DIGITS = re.compile(r"([0-9]+)")
_SAMPLES = 9
THUMBNAIL = (32, 24)
_BEFORE_BLUR = 128  # pixels across
_OF_PILLOW = r"PIL\.|conformodal\.datasets\.decoding$"
_guard = threading.Lock()
_inside: list[int] = []  # threads, once for each time that they came in
_filters = ExitStack()


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """Sorts names by the numbers in them: ``frame2`` before ``frame10``."""
    parts = _DIGITS.split(name)
    return tuple(int(part) if k % 2 else part for k, part in enumerate(parts)), name


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, without decoding the image; of one that is turned, after turning."""
    with _opened(path, str(path)) as image:
        return _size(image)


def _size(image: Image.Image) -> tuple[int, int]:
    sideways = image.format != "TIFF" and _orientation(image) >= SIDEWAYS  # Pillow turns a TIFF itself
    return (image.height, image.width) if sideways else (image.width, image.height)


def orientation(path: Path) -> tuple[int, tuple[int, int]]:
    """EXIF's orientation, and width and height as stored; 1 where nothing is to turn it, as Pillow turns a TIFF."""
    with suppress(ImageError), _opened(path, "") as image:
        return 1 if image.format == "TIFF" else _orientation(image), image.size
    return 1, (0, 0)


def looked_at(paths: list[Path]) -> tuple[int | None, tuple[float, float], list[str]]:
    """White level of a few evenly spread images, None for 8 bits; what nearly all of their numbers lie between; turned.

    The last are the names of those that are to be turned.
    """
    white, low, high, turned = None, np.inf, -np.inf, []
    for i in evenly_spread(len(paths), _SAMPLES):
        with suppress(Exception), _opened(paths[i], "") as image:  # images that cannot be read are told elsewhere
            turned += [str(paths[i])] if _orientation(image) != 1 else []
            if (wide := _wide(image, paths[i])) is not None:
                white = max(white or 0, white_level(wide[..., :3]))
                its = np.percentile(wide[..., :3], (0.5, 99.5))
                low, high = min(low, float(its[0])), max(high, float(its[1]))
    return white, (low, high), turned


def white_in(content: bytes) -> int:
    """The level that is shown as white in an image file's content: 255 with 8 bits, or where it is not an image."""
    with suppress(Exception), _opened(content, "") as image:
        if (wide := _wide(image, content)) is not None:
            return white_level(wide[..., :3])
    return 255


def _wide(image: Image.Image, source: Path | bytes) -> AnyArray | None:
    """The numbers (height, width, 1, 3 or 4) of an image of 16 bits, not turned; None for one of 8.

    Pillow keeps only the upper half of the bits of colours.
    """
    tile = getattr(image, "tile", None)
    raw = str(tile[0][3]) if tile else ""
    if image.mode == "I" or image.mode.startswith("I;16"):
        return np.clip(np.asarray(image).astype(np.int64), 0, WIDEST)[..., None]
    if ";16" not in raw and not (image.format == "PPM" and str(WIDEST) in raw):
        return None
    image.load()  # which refuses truncated files
    content = np.frombuffer(source if isinstance(source, bytes) else source.read_bytes(), dtype=np.uint8)
    found = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    if found is None or found.dtype != np.uint16 or found.shape[:2] != (image.height, image.width):
        raise ValueError("its 16-bit colours cannot be decoded")
    return found[..., [2, 1, 0, 3][: found.shape[2]]] if found.ndim == 3 else found[..., None]


def common_size(paths: list[Path]) -> tuple[int, int]:
    """The size that most of a few evenly spread images have; else that of the first image that can be read."""
    found: Counter[tuple[int, int]] = Counter()
    spread = evenly_spread(len(paths), _SAMPLES).tolist()
    first: ImageError | None = None
    for i in [*spread, *(k for k in range(len(paths)) if k not in spread)]:
        if i not in spread and found:
            break
        try:
            found[image_size(paths[i])] += 1
        except ImageError as exc:
            first = first or exc
    if not found:
        assert first is not None
        raise first
    return found.most_common(1)[0][0]


def image_fault(path: Path, size: tuple[int, int]) -> str:
    """Why a file is no image of a size, or nothing. Decodes it only where its end does not look like one."""
    try:
        found = image_size(path)
        if found != size:
            return f"{path}: image is {found[0]}x{found[1]} pixels, the camera's are {size[0]}x{size[1]}"
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
        If the file is missing, truncated or no image, of another size, holds several pictures or numbers that have no
        range (32 bits, floating point). (Pillow refuses truncated files; some decoders fill the rest with grey in
        silence.)
    """
    return decode(path, str(path), size)


def decode(
    source: Path | bytes, name: str, size: tuple[int, int] | None = None, white: int | None = None, turn: bool = True
) -> UInt8Array:
    """As :func:`read_image`, of a file or of its content.

    `name` is for people; `white` the level of a 16-bit image that becomes 255, by default of the bits that it uses;
    without `turn` the image stays as it is stored.
    """
    with _opened(source, name) as image:
        if not turn:
            image.info.pop("exif", None)
        found = _size(image)
        if size is not None and found != size:
            raise ImageError(f"{name}: image is {found[0]}x{found[1]} pixels, the camera's are {size[0]}x{size[1]}")
        try:
            with ignore_pillow_warnings():
                return _rgb(image, source, white)
        except Exception as exc:  # decoders raise whatever damaged bytes lead them to
            raise ImageError(f"{name}: cannot be decoded as an image: {type(exc).__name__}: {exc}") from exc


def _opened(source: Path | bytes, name: str) -> Image.Image:
    if isinstance(source, Path) and not os.path.isfile(source):
        raise ImageError(f"{name}: {'is no file' if os.path.exists(source) else 'image is missing'}")
    try:
        with ignore_pillow_warnings():  # of sizes, which are checked below
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
    pixels = image.width * image.height
    if pixels > max(_FREE_PIXELS, min(_MOST_PIXELS, _PIXELS_A_BYTE * n_bytes)):
        return f"claims {image.width}x{image.height} pixels in {n_bytes} bytes: too many to be an image of a camera"
    n_pictures = 1 if image.format == "MPO" else getattr(image, "n_frames", 1)
    if n_pictures != 1:
        return f"holds {n_pictures} pictures, expected one; write each into a file of its own"
    if image.mode == "F" or (image.mode == "I" and image.format not in ("PNG", "PPM")):
        kind = "floating point" if image.mode == "F" else "32-bit"
        return f"holds {kind} numbers, which have no white; expected 8 or 16 bits: scale and write it anew"
    return ""


def _orientation(image: Any) -> int:
    if image.format == "TIFF":
        return int(image.tag_v2.get(_ORIENTATION, 1))
    if "exif" not in image.info:
        return 1
    exif = Image.Exif()
    try:
        exif.load(image.info["exif"])
        found = int(exif.get(_ORIENTATION, 1))
    except Exception:  # damaged notes beside the picture say nothing
        return 1
    return found if 1 <= found <= 8 else 1


def exif_focal_px(path: Path, size: tuple[int, int]) -> tuple[float | None, str]:
    """The focal length in pixels that EXIF says, and how well it does; None if it says none."""
    try:
        with ignore_pillow_warnings(), _opened(path, "") as image:
            exif = image.getexif().get_ifd(_EXIF)
            film_mm, mm = (float(exif.get(tag, 0)) for tag in (_FOCAL_35_MM, _FOCAL_MM))
            per_unit, unit = float(exif.get(_PLANE_RESOLUTION, 0)), int(exif.get(_PLANE_UNIT, 2))
            side = max(float(exif.get(tag, 0)) for tag in (_EXIF_WIDTH, _EXIF_HEIGHT))
    except Exception:  # damaged notes, as above
        return None, ""
    if 1 < film_mm < 10_000:  # which has the view of this length across the diagonal of 36 x 24 mm
        rounded = 50 / film_mm
        return film_mm / _DIAGONAL_MM * hypot(
            *size
        ), f"of EXIF's {film_mm:g} mm on film, give or take {5 + rounded:.0f} %"
    if mm > 0 and per_unit > 0 and side > 0 and unit in _UNIT_MM:
        return mm * per_unit / _UNIT_MM[unit] * max(size) / side, "of EXIF's sensor and lens, give or take 5 %"
    return None, ""


def _rgb(image: Image.Image, source: Path | bytes, white: int | None) -> UInt8Array:
    turned = _orientation(image)
    if (wide := _wide(image, source)) is not None:
        eight = to_eight_bits(wide[..., :3], white or white_level(wide[..., :3]))
        if image.format == "TIFF" and image.tag_v2.get(_PHOTOMETRIC) == 0:  # type: ignore[attr-defined]
            eight = 255 - eight  # its zero is white, which Pillow passes over
        eight = np.concatenate((eight, to_eight_bits(wide[..., 3:], WIDEST)), axis=2)
        image = Image.fromarray(np.repeat(eight, 3, axis=2) if eight.shape[2] == 1 else eight)
        image.getexif()[_ORIENTATION] = turned
    image = image if turned == 1 else ImageOps.exif_transpose(image)
    if not image.has_transparency_data:
        return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    rgba = np.asarray(image.convert("RGBA"))
    alpha = rgba[..., 3:]
    if alpha.min() == 255:
        return np.ascontiguousarray(rgba[..., :3])
    return np.asarray((rgba[..., :3].astype(np.uint16) * alpha + 127) // 255, dtype=np.uint8)


def white_level(wide: AnyArray) -> int:
    """The largest number of the bits that a 16-bit image uses: sensors have 10, 12, 14 or 16."""
    most = int(wide.max(initial=0))
    return next(white for white in _WHITES if most <= white)


def to_eight_bits(wide: AnyArray, white: int) -> UInt8Array:
    """Numbers of a 16-bit image at 8 bits, where `white` becomes 255."""
    return np.asarray((np.minimum(wide.astype(np.int64), white) * 255 + white // 2) // white, dtype=np.uint8)


@contextmanager
def ignore_pillow_warnings() -> Iterator[None]:
    """Ignore Pillow's warnings and no others.

    Python's filters belong to the whole process: the first thread that enters changes them, the last one restores them.
    """
    with _guard:
        if not _inside:
            _filters.enter_context(warnings.catch_warnings())
            warnings.filterwarnings("ignore", module=_OF_PILLOW)
        _inside.append(threading.get_ident())
    try:
        yield
    finally:
        with _guard:
            _inside.pop()
            if not _inside:
                _filters.close()


def thumbnail(image: UInt8Array) -> Float32Array:
    """The picture (768,) of an image (height, width[, 3]), RGB or grey: of zero mean and unit length.

    Zero for an image without contrast.
    """
    height, width = image.shape[:2]
    before = (_BEFORE_BLUR, max(1, round(height * _BEFORE_BLUR / width)))
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.GaussianBlur(cv2.resize(grey, before, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    picture = cv2.resize(small, THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    picture -= picture.mean()
    return np.asarray(picture / max(float(np.linalg.norm(picture)), 1e-6), dtype=np.float32)


def grey_image(image: UInt8Array) -> UInt8Array:
    """An image (height, width[, 3]) as the tracker takes it."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(grey, dtype=np.uint8)
