"""Small files that data sets are made of, with errors that name them, and the images of a folder in order."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray

from .errors import DatasetError

Item = TypeVar("Item")

FRAME_RATE_HZ = 30.0
BETWEEN_RECORDINGS_S = 10.0
_RATES_HZ = (1e-3, 1e6)
_DIGITS = re.compile(r"([0-9]+)")
_NO_NUMBER = str.maketrans("[](),;", " " * 6)
# What a file of another kind leads to, when it is taken for YAML or JSON of a known form.
MALFORMED = (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError)
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")


class Note(NamedTuple):
    """Something that a reader found wrong: what it is, and where, file or frame first."""

    what: str
    where: str


def by_what(notes: Iterable[Note]) -> dict[str, list[str]]:
    """Where each kind of notes was found."""
    places: dict[str, list[str]] = {}
    for note in notes:
        places.setdefault(note.what, []).append(note.where)
    return places


def readable(name: str) -> bool:
    """Whether a file's name is text: names that are not UTF-8 can be put into no result."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def shown(name: str) -> str:
    """A file's name for people, whatever bytes it has."""
    return name.encode(errors="surrogateescape").decode(errors="backslashreplace")


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


def numbers_in(line: str) -> list[float]:
    """The numbers of a line."""
    return [number(token) for token in tokens(line)]


def read_lines(path: Path) -> list[str]:
    """Lines of a text file in UTF-8, with the line ends of any system."""
    try:
        if path.exists() and not os.path.isfile(path):  # a pipe would be waited for
            raise OSError("is not a regular file")
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as exc:
        raise DatasetError(f"{path}: cannot be read: {exc}") from exc


@dataclass(frozen=True)
class ParsedLine(Generic[Item]):
    """A line of a file: its place, its text, and what it holds, None if it is damaged."""

    where: str
    text: str
    value: Item | None

    def fault(self, expected: str) -> str:
        """What is wrong with a damaged line."""
        return f"{self.where}: expected {expected}, got {self.text[:80]!r}"


def parse_lines(path: Path, parse: Callable[[str], Item], *, by_line: bool = False) -> list[ParsedLine[Item]]:
    """What the lines of a file hold; blank lines, those that start with ``#``, and a header of words are left out.

    Parameters
    ----------
    parse
        Turns a line into what it holds; raises ValueError or IndexError where it is damaged.
    by_line
        Whether lines belong to frames by their order: a blank line between them, or a header, is then refused.
    """
    parsed: list[ParsedLine[Item]] = []
    blank = 0
    for at, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            blank = blank or (at if parsed else 0)
            continue
        if line.lstrip().startswith("#"):
            continue
        if by_line and blank:
            raise DatasetError(f"{path}, line {blank}: is blank; poses belong to frames by their lines")
        try:
            value = parse(line)
        except DatasetError:
            raise
        except (ValueError, IndexError):
            if not parsed and line.lstrip()[:1] not in "+-.0123456789":  # begins as no number does
                if by_line:
                    what = "begins with a word; poses belong to frames by their lines; put # before a header"
                    raise DatasetError(f"{path}, line {at}: {what}") from None
                continue
            value = None
        parsed.append(ParsedLine(f"{path}, line {at}", line, value))
    return parsed


def read_numbers(path: Path) -> FloatArray:
    """All numbers of a text file, in one vector; brackets, commas and lines that begin with ``#`` are passed over."""
    lines = [line for line in read_lines(path) if not line.lstrip().startswith("#")]
    try:
        return np.array([number(x) for x in " ".join(lines).translate(_NO_NUMBER).split()])
    except ValueError as exc:
        raise DatasetError(f"{path}: cannot be read as numbers: {exc}") from exc


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """Sorts names by the numbers in them: ``frame2`` before ``frame10``."""
    parts = _DIGITS.split(name)
    return tuple(int(part) if k % 2 else part for k, part in enumerate(parts)), name


def by_name(items: Iterable[Item], name: Callable[[Item], str]) -> list[Item]:
    """Items in the natural order of their names, 2 before 10; in that of numbers where all names are decimals."""
    ordered = sorted(items, key=lambda item: natural_key(name(item)))
    stems = [Path(name(item)).stem for item in ordered]
    try:
        decimals = [number(stem) for stem in stems if "." in stem]
    except ValueError:
        return ordered
    return [ordered[i] for i in np.argsort(decimals, kind="stable")] if len(decimals) == len(ordered) else ordered


def image_files(folder: Path) -> list[Path]:
    """Image files of a folder in the order of their names; hidden files are left out."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    images = by_name(paths, lambda path: path.name)
    _refuse_twice([path.stem for path in images], images)
    return images


def _refuse_twice(keys: list[str] | list[int], paths: list[Path]) -> None:
    """Refuse two files for one frame, such as a .jpg beside a .png."""
    for key, count in Counter(keys).items():
        if count > 1:
            first, second = [path for path, other in zip(paths, keys, strict=True) if other == key][:2]
            raise DatasetError(f"{second}: is one frame with {first.name}, expected one file per frame; remove one")


def file_named(base: Path, name: str) -> Path:
    """The file that a list of a data set names, also as Windows writes it."""
    if "\0" in name:
        raise DatasetError(f"{base}: {name[:80]!r} is not a file name")
    path = base / name
    return base / name.replace("\\", "/") if "\\" in name and not path.exists() else path


def listed_images(
    path: Path, parse: Callable[[str], tuple[float, Path]], expected: str, notes: list[Note]
) -> tuple[list[Path], FloatArray]:
    """Images and times of a list with one per line; damaged lines are left out and told."""
    lines = parse_lines(path, parse)
    listed = [line.value for line in lines if line.value is not None]
    faults = [line.fault(expected) for line in lines if line.value is None]
    if not listed:
        raise DatasetError(faults[0] if faults else f"{path}: lists no image")
    notes += [Note("left out, line cannot be read", fault) for fault in faults]
    return [image for _, image in listed], np.array([time for time, _ in listed])


def rows_of(images: list[Path], n_rows: int, path: Path, what: str) -> IntArray:
    """Which line of a file is about which image: all in order, or the one whose number is the image's name."""
    numbers = numbers_of(images)
    in_order = numbers is None or bool((np.diff(numbers) == 1).all())
    if in_order and n_rows == len(images):
        return np.arange(n_rows)
    if numbers is not None and numbers.max() < n_rows:
        return numbers
    raise DatasetError(f"{path}: holds {n_rows} {what} {len(images)} images")


def numbers_of(images: list[Path]) -> IntArray | None:
    """The images' names, if each is a number."""
    stems = [image.stem for image in images]
    numbered = all(stem.isascii() and stem.isdigit() and len(stem) < 10 for stem in stems)
    return np.array([int(stem) for stem in stems], dtype=np.int64) if numbered else None


def numbered_frames(folder: Path, pattern: re.Pattern[str]) -> list[tuple[int, Path]]:
    """Numbers and paths of a folder's images, in order; the first group of the pattern is the number."""
    frames = sorted((int(m[1]), path) for path in folder.iterdir() if (m := pattern.fullmatch(path.name)))
    _refuse_twice([number for number, _ in frames], [path for _, path in frames])
    return frames


def recording_folders(parent: Path, prefix: str, notes: list[Note]) -> list[Path]:
    """Folders of recordings, prefix and number, in the order of their numbers; `notes` takes up similar ones."""
    paths = sorted(path for path in parent.glob(f"{prefix}*") if path.is_dir())
    numbered = [path for path in paths if re.fullmatch(r"[0-9]{1,9}", path.name.removeprefix(prefix))]
    notes += [Note("left out, not a recording", f"{p}: is not called {prefix}NN") for p in paths if p not in numbered]
    numbers = [int(path.name.removeprefix(prefix)) for path in numbered]
    _refuse_twice(numbers, numbered)
    return [numbered[i] for i in np.argsort(numbers, kind="stable")]


def joined_recordings(
    recordings: list[list[tuple[int, Path]]], rate_hz: float
) -> tuple[list[Path], FloatArray, IntArray]:
    """Images, times and recording numbers of numbered frames; each recording begins 10 s after the one before."""
    times: list[float] = []
    for frames in recordings:
        start = times[-1] + BETWEEN_RECORDINGS_S if times else 0.0
        times += [start + i / rate_hz for i, _ in frames]
    recording = np.repeat(np.arange(len(recordings)), np.array([len(frames) for frames in recordings], dtype=np.int64))
    return [path for frames in recordings for _, path in frames], np.array(times), recording


def frame_times(folder: Path, n_frames: int) -> FloatArray:
    """Times of frames whose layout has none, (n_frames,) seconds: ``times.txt`` in the folder, or even ones."""
    path = folder / "times.txt"
    if not path.is_file():
        rate = folder / "frame-rate.txt"
        return np.arange(n_frames) / (read_frame_rate(rate) if rate.is_file() else FRAME_RATE_HZ)
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


def read_frame_rate(path: Path) -> float:
    """The number of ``frame-rate.txt``, Hz."""
    rate = read_numbers(path)
    if rate.size != 1 or not _RATES_HZ[0] <= rate[0] <= _RATES_HZ[1]:
        raise DatasetError(
            f"{path}: holds {rate[:9].tolist()}, expected a positive frame rate, {_RATES_HZ[0]:g} to "
            f"{_RATES_HZ[1]:g} Hz"
        )
    return float(rate[0])
