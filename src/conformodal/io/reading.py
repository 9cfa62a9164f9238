"""Small files that data sets are made of, with errors that name them, and the images of a folder in order."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.files import foreign_kind, read_file

from .errors import DatasetError

Item = TypeVar("Item")

FRAME_RATE_HZ = 30.0
BETWEEN_RECORDINGS_S = 10.0
_RATES_HZ = (1e-3, 1e6)
_DIGITS = re.compile(r"([0-9]+)")
# What a file of another kind leads to, when it is taken for YAML or JSON of a known form.
MALFORMED = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError)
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")


class Note(NamedTuple):
    """Something that a reader found wrong: what it is, and where, file or frame first."""

    what: str
    where: str


def group_by_kind(notes: Iterable[Note]) -> dict[str, list[str]]:
    """Where each kind of notes was found."""
    places: dict[str, list[str]] = {}
    for note in notes:
        places.setdefault(note.what, []).append(note.where)
    return places


def number(text: str) -> float:
    """A number written in ASCII digits; ``float`` also takes ``1_0`` and digits of other scripts."""
    if not text.isascii() or "_" in text:
        raise ValueError(f"{text[:80]!r} is not a number")
    return float(text)


def whole_number(text: str) -> int:
    """As :func:`number`, of an integer below 10^20."""
    if not text.isascii() or "_" in text or len(text) > 20:
        raise ValueError(f"{text[:80]!r} is not a whole number")
    return int(text)


def tokens(line: str) -> list[str]:
    """What stands between commas, or semicolons, or blanks: one of them separates a line."""
    separator = next((mark for mark in ",;" if mark in line), None)
    return [token.strip() for token in line.strip().removesuffix(separator or "").split(separator)]


def numbers_in(line: str, count: int | None = None) -> list[float]:
    """The numbers of a line, so many if that is given."""
    numbers = [number(token) for token in tokens(line)]
    if count not in (None, len(numbers)):
        raise ValueError(f"expected {count} numbers, got {len(numbers)}")
    return numbers


def read_lines(path: Path) -> list[str]:
    """Lines of a text file in UTF-8, with the line ends of any system, without blank ones at the end."""
    try:
        content = read_file(path)
        if kind := foreign_kind(content):
            raise DatasetError(f"{path}: {kind}")
        return content.decode("utf-8-sig").rstrip().splitlines()
    except DatasetError:
        raise
    except (OSError, ValueError) as exc:
        raise DatasetError(f"{path}: cannot be read: {getattr(exc, 'strerror', None) or exc}") from exc


def parse_lines(path: Path, parse: Callable[[str], Item], expected: str, *, by_line: bool = False) -> list[Item]:
    """What the lines of a file hold, at least one; lines that start with ``#`` are left out.

    `parse` raises ValueError or IndexError for a damaged line; `expected` is what a line should be, for messages. Blank
    lines and a header of words are left out too, unless lines belong to frames by their order (`by_line`).
    """
    items: list[Item] = []
    for at, line in enumerate(read_lines(path), start=1):
        if line.lstrip().startswith("#") or not (by_line or line.strip()):
            continue
        try:
            items.append(parse(line))
        except DatasetError:
            raise
        except (ValueError, IndexError):
            is_header = not items and not by_line and line.lstrip()[0] not in "+-.0123456789"
            if not is_header:
                raise DatasetError(f"{path}, line {at}: expected {expected}, got {line[:80]!r}") from None
    if not items:
        raise DatasetError(f"{path}: holds no line of {expected}")
    return items


def read_numbers(path: Path) -> FloatArray:
    """All numbers of a text file, in one vector; lines that begin with ``#`` are passed over."""
    lines = [line for line in read_lines(path) if line.strip() and not line.lstrip().startswith("#")]
    try:
        return np.array([value for line in lines for value in numbers_in(line)])
    except ValueError as exc:
        raise DatasetError(f"{path}: cannot be read as numbers: {exc}") from exc


def by_name(items: Iterable[Item], name: Callable[[Item], str]) -> list[Item]:
    """Items in the natural order of their names, 2 before 10; refuses decimals whose order depends on their zeros."""

    def key(item: Item) -> tuple[tuple[str | int, ...], str]:
        parts = _DIGITS.split(name(item))
        return tuple(int(part) if k % 2 else part for k, part in enumerate(parts)), name(item)

    ordered = sorted(items, key=key)
    stems = [Path(name(item)).stem for item in ordered]
    try:
        decimals = [number(stem) for stem in stems if "." in stem]
    except ValueError:
        return ordered
    back = np.flatnonzero(np.diff(decimals) < 0)
    if len(decimals) == len(ordered) and back.size:
        first, second = (name(ordered[k]) for k in (back[0], back[0] + 1))
        raise DatasetError(f"{first} and {second}: their order is unclear; name all images with as many decimals")
    return ordered


def image_files(folder: Path) -> list[Path]:
    """Image files of a folder in the order of their names; hidden files are left out."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    images = by_name(paths, lambda path: path.name)
    _refuse_twice([path.stem for path in images], images)
    return images


def _refuse_twice(keys: Sequence[str | int], paths: list[Path]) -> None:
    """Refuse two files for one frame, such as a .jpg beside a .png."""
    first: dict[str | int, Path] = {}
    for key, path in zip(keys, paths, strict=True):
        if (other := first.setdefault(key, path)) is not path:
            raise DatasetError(f"{path}: is one frame with {other.name}, expected one file per frame; remove one")


def file_named(base: Path, name: str) -> Path:
    """The file that a list of a data set names, also as Windows writes it, or in another case or Unicode form."""
    if "\0" in name:
        raise DatasetError(f"{base}: {name[:80]!r} is not a file name")
    paths = [base / name, base / name.replace("\\", "/")]
    return next((path for path in paths if os.path.lexists(path)), None) or _as_stored(paths[1])


def _as_stored(path: Path) -> Path:
    """The only path that differs from one that is missing in case or Unicode form alone, or that one itself."""
    if os.path.lexists(path) or path == path.parent:
        return path
    parent = _as_stored(path.parent)
    with suppress(OSError):
        alike = _names_alike(parent, parent.stat().st_mtime_ns).get(_folded(path.name), [])
        return parent / (alike[0] if len(alike) == 1 else path.name)
    return path


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


@lru_cache(maxsize=8)  # many images of one folder may be named so
def _names_alike(folder: Path, mtime_ns: int) -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for name in os.listdir(folder):
        names.setdefault(_folded(name), []).append(name)
    return names


def numbered_frames(folder: Path, pattern: re.Pattern[str]) -> list[tuple[int, Path]]:
    """Numbers and paths of what a folder holds, in order; the first group of the pattern is the number."""
    frames = sorted((int(m[1]), path) for path in folder.iterdir() if (m := pattern.fullmatch(path.name)))
    _refuse_twice([number for number, _ in frames], [path for _, path in frames])
    return frames


def recording_folders(parent: Path, prefix: str) -> list[Path]:
    """Folders of recordings, prefix and number, in the order of their numbers."""
    if not parent.is_dir():
        return []
    numbered = numbered_frames(parent, re.compile(rf"{prefix}([0-9]{{1,9}})"))
    return [path for _, path in numbered if path.is_dir()]


def frame_times(folder: Path, n_frames: int) -> FloatArray:
    """Times of frames whose layout has none, (n_frames,) seconds: ``times.txt`` in the folder, or even ones."""
    path = folder / "times.txt"
    if not path.is_file():
        return np.arange(n_frames) / read_frame_rate(folder / "frame-rate.txt")
    times = read_numbers(path)
    if times.size != n_frames:
        raise DatasetError(f"{path}: holds {times.size} times for {n_frames} images")
    return times


def times_by_folder(folder: Path, images: list[Path]) -> tuple[FloatArray, IntArray]:
    """As :func:`frame_times`, and recordings (n,): images that follow each other in one folder are one."""
    changes = [one.parent != other.parent for one, other in zip(images[1:], images, strict=False)]
    recording = np.cumsum([False, *changes][: len(images)], dtype=np.int64)
    times = frame_times(folder, len(images))
    return times if (folder / "times.txt").is_file() else times + BETWEEN_RECORDINGS_S * recording, recording


def read_frame_rate(path: Path | None) -> float:
    """The number of ``frame-rate.txt``, Hz; 30 where there is no such file."""
    if path is None or not path.is_file():
        return FRAME_RATE_HZ
    rate = read_numbers(path)
    if rate.size != 1 or not _RATES_HZ[0] <= rate[0] <= _RATES_HZ[1]:
        raise DatasetError(f"{path}: holds {rate[:9].tolist()}, expected a positive frame rate in Hz")
    return float(rate[0])
