"""Small files that data sets are made of, with kind errors."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import PoseError

from .decoding import natural_key
from .errors import DatasetError
from .pose_text import TrajectoryFileError, fractions_of, number, text_lines

P = ParamSpec("P")
Read = TypeVar("Read")
Item = TypeVar("Item")

FRAME_RATE_HZ = 30.0
NUMBERS = "numbers can be read in two ways"
BETWEEN_RECORDINGS_S = 10.0
_RATES_HZ = (1e-3, 1e6)
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
    found: dict[str, list[str]] = {}
    for note in notes:
        found.setdefault(note.what, []).append(note.where)
    return found


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


def reader(read: Callable[P, Read]) -> Callable[P, Read]:
    """Let a layout's reader raise this package's errors alone, whatever the file system says."""

    @functools.wraps(read)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Read:
        folder = str(args[0] if args else kwargs["folder"])
        if not readable(folder):
            raise DatasetError(f"{shown(folder)}: its name is not UTF-8; rename it")
        try:
            return read(*args, **kwargs)
        except TrajectoryFileError as exc:
            raise DatasetError(str(exc)) from exc
        except (OSError, UnicodeError, PoseError) as exc:
            raise DatasetError(shown(f"{folder}: cannot be read: {exc}")) from exc

    return wrapped


def by_name(items: Iterable[Item], name: Callable[[Item], str], notes: list[Note] | None = None) -> list[Item]:
    """Items in the natural order of their names: 2 before 10, and 2.5 after 2.25 where these are decimals."""
    listed = sorted(items, key=lambda item: natural_key(name(item)))
    numbers = fractions_of([name(item) for item in listed])
    if numbers is not None and numbers[1] and notes is not None:
        notes.append(Note(NUMBERS, numbers[1]))
    return listed if numbers is None else [listed[i] for i in np.argsort(numbers[0], kind="stable")]


def image_files(folder: Path, notes: list[Note] | None = None) -> list[Path]:
    """Image files of a folder in the natural order of their names; hidden files are none.

    Of files with one name and several suffixes the first in ``SUFFIXES`` counts; `notes` takes up the others.
    """
    found: dict[str, Path] = {}
    paths = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    for path in sorted(paths, key=lambda p: (SUFFIXES.index(p.suffix.lower()), p.name)):
        first = found.setdefault(path.stem, path)
        if first is not path and notes is not None:
            notes.append(Note("left out, another file has its name", f"{path}: {first.name} has its name"))
    return by_name(found.values(), lambda path: path.name, notes)


class PathGuard:
    """Files that the list `source` of a data set names.

    Names that lead out of the folder, as absolute paths or by ``..``, are refused unless `follow_outside`. Links are
    followed in any case: they are the choice of whoever keeps the folder, not of the list.
    """

    def __init__(self, folder: Path, source: Path, *, follow_outside: bool) -> None:
        self.folder, self.source, self.follow_outside = folder, source, follow_outside
        self._root = os.path.realpath(folder)
        self._places: dict[str, str] = {}  # where folders really are

    def __call__(self, base: Path, name: str) -> Path:
        """The file of a name, from a base in the folder."""
        if "\0" in name:
            raise DatasetError(f"{self.source}: names {name[:80]!r}, which is no file name")
        if "\\" in name and not os.path.lexists(os.path.join(base, name)):  # written on Windows
            name = name.replace("\\", "/")
        path = os.path.join(base, name)
        written = Path(name)
        leads_out = written.anchor or ".." in written.parts
        if leads_out and not self.follow_outside and not self._lies_inside(path):
            raise DatasetError(
                f"{self.source}: names {name!r}, which lies outside {self.folder}; link it into the folder, or let it "
                "be followed with follow_outside (--follow-outside on the command line)"
            )
        return Path(path)

    def _lies_inside(self, path: str) -> bool:
        place, last = os.path.split(path)
        if place not in self._places:
            self._places[place] = os.path.realpath(place)
        real = os.path.join(self._places[place], last)
        if last in ("", ".", "..") or os.path.islink(real):
            real = os.path.realpath(real)
        return real == self._root or real.startswith(self._root.rstrip(os.sep) + os.sep)


def read_lines(path: Path) -> list[str]:
    """Lines of a text file."""
    try:
        return text_lines(path)
    except (OSError, ValueError) as exc:
        raise DatasetError(f"{path}: cannot be read: {exc}") from exc


def read_numbers(path: Path) -> FloatArray:
    """All numbers of a text file, in one vector; brackets, commas and lines that begin with ``#`` are passed over."""
    lines = [line for line in read_lines(path) if not line.lstrip().startswith("#")]
    try:
        return np.array([number(x) for x in " ".join(lines).translate(_NO_NUMBER).split()])
    except ValueError as exc:
        raise DatasetError(f"{path}: cannot be read as numbers: {exc}") from exc


def frame_times(folder: Path, n_frames: int) -> FloatArray:
    """Times of frames whose layout has none, (n_frames,) seconds: ``times.txt`` in the folder, or even ones."""
    path = folder / "times.txt"
    if not path.is_file():
        return even_times(folder, n_frames)
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


def even_times(folder: Path, n_frames: int) -> FloatArray:
    """Times of frames that come with none, (n_frames,) seconds: ``frame-rate.txt`` (Hz) in the folder, else 30 Hz."""
    path = folder / "frame-rate.txt"
    return np.arange(n_frames) / (read_frame_rate(path) if path.is_file() else FRAME_RATE_HZ)


def read_frame_rate(path: Path) -> float:
    """The number of ``frame-rate.txt``, Hz."""
    rate = read_numbers(path)
    if rate.size != 1 or not _RATES_HZ[0] <= rate[0] <= _RATES_HZ[1]:
        raise DatasetError(
            f"{path}: holds {rate[:9].tolist()}, expected a positive frame rate, {_RATES_HZ[0]:g} to "
            f"{_RATES_HZ[1]:g} Hz"
        )
    return float(rate[0])
