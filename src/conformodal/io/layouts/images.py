"""A folder of images, with poses in a file beside them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.io.cameras import INTRINSICS, camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import tum_table
from conformodal.io.reading import SUFFIXES, Note, frame_times, image_files, number

POSE_FILES = ("poses.tum", "groundtruth.txt")
_FEW = 3
_NUMBERS, _NUMBERED = re.compile(r"[0-9]+"), re.compile(r"\D*([0-9]{1,9})\D*")
# Whole numbers that are times: seconds, milli-, micro- or nanoseconds since 1970, between 2001 and 2128; not dates.
_SINCE_1970 = [(unit, 5 * unit) for unit in (1e9, 1e12, 1e15, 1e18)]


def looks_like_images(folder: Path) -> bool:
    """Whether there are images beside a camera or poses; other layouts may claim such a folder before."""
    described = any((folder / name).is_file() for name in (INTRINSICS, *POSE_FILES))
    return described and bool(image_files(folder))


def read_image_folder(folder: Path) -> FrameTable:
    """Read images of one camera, in the natural order of their names (2 before 10).

    Beside them ``camera-intrinsics.txt`` (3x3). Times are those of ``times.txt`` (seconds, one per line), or the names
    of the files where all of these are numbers with a fraction or since 1970, or else even (``frame-rate.txt`` in Hz,
    or 30). Poses: ``poses.tum`` or ``groundtruth.txt``, interpolated by time.
    """
    notes: list[Note] = []
    images = image_files(folder)
    if not images:
        raise DatasetError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    _refuse_kinds(folder, images)
    times = None if (folder / "times.txt").is_file() else _times_in_names(images)
    if times is None:
        times = frame_times(folder, len(images))
        _note_gaps(folder, images, notes)
    table = FrameTable(folder.name, images, times, camera_beside(folder, common_size(images), None, notes), notes=notes)
    path, *others = [folder / name for name in POSE_FILES if (folder / name).is_file()] or [folder / POSE_FILES[0]]
    table.source = folder if path.is_file() else path
    if others:
        raise DatasetError(f"{folder}: holds poses in {path.name} and in {others[0].name}; remove one")
    if path.is_file():
        table.add_poses(tum_table, path)
    return table


def _refuse_kinds(folder: Path, images: list[Path]) -> None:
    """Refuse images of several kinds or cameras: names that differ in letters, and have their numbers in common."""
    kinds: dict[str, dict[tuple[str, ...], str]] = {}
    for image in images:
        kinds.setdefault(_NUMBERS.sub("#", image.stem), {})[tuple(_NUMBERS.findall(image.stem))] = image.name
    first, *others = sorted(kinds.values(), key=len, reverse=True)
    for other in others:
        both = first.keys() & other.keys()
        if len(both) >= max(_FEW, len(other) / 2) and 2 * len(other) >= len(first):
            names = f"{first[min(both)]} and {other[min(both)]}"
            what = f"images of two kinds, such as {names}, which {len(both)} numbers have in common"
            raise DatasetError(f"{folder}: holds {what}; expected one camera's")


def _note_gaps(folder: Path, images: list[Path], notes: list[Note]) -> None:
    """Tell that times are even although the numbers in the names have gaps."""
    matches = [_NUMBERED.fullmatch(image.stem) for image in images]
    steps = np.diff([int(match[1]) for match in matches if match is not None])
    if (folder / "times.txt").is_file() or None in matches or len(images) < _FEW or steps.min() < 1:
        return
    if steps.max() > steps.min():
        gap = int(np.argmax(steps))
        where = f"{folder}: {images[gap].name} is followed by {images[gap + 1].name}, and times are even"
        notes.append(Note("names skip numbers", f"{where}; write times.txt (seconds, one per line)"))


def _times_in_names(images: list[Path]) -> FloatArray | None:
    """Times of images, where the names of all are times."""
    try:
        named = np.array([number(image.stem) for image in images])
    except ValueError:
        return None
    since_1970 = any(((low < named) & (named < high)).all() for low, high in _SINCE_1970)
    fractions = all("." in image.stem for image in images)
    return named if np.isfinite(named).all() and (since_1970 or fractions) else None
