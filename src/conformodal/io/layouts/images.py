"""A folder of images, with poses in a file beside them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable, paired_by_time
from conformodal.io.pose_files import kitti_table, tum_table
from conformodal.io.pose_text import TrajectoryFileError, fractions_of, number
from conformodal.io.reading import SUFFIXES, Note, even_times, frame_times, image_files, reader
from conformodal.io.recording import Recording

_TUM, _KITTI = ("poses.tum", "groundtruth.txt"), ("poses.kitti", "poses.txt")
POSE_FILES = (*_TUM, *_KITTI)
_FEW = 3
_NUMBERS, _NUMBERED = re.compile(r"[0-9]+"), re.compile(r"(\D*)([0-9]{1,9})(\D*)")
_SINCE_1970_S = 1e9  # more than the number of any image
_DATE = re.compile(r"20[0-9]{2}(0[1-9]|1[0-2])([0-2][0-9]|3[01])([01][0-9]|2[0-3])[0-5][0-9][0-5][0-9]")  # no number


@reader
def read_image_folder(folder: Path | str, *, require_poses: bool = True, focal_px: float | None = None) -> Recording:
    """Read images of one camera, in the natural order of their names (2 before 10), without decoding them.

    Parameters
    ----------
    folder
        With the images and ``camera-intrinsics.txt`` (3x3). Times are those of ``times.txt`` (seconds, one per line),
        or the names of the files where all of these are numbers with a fraction or since 1970, no dates, or else even
        (``frame-rate.txt`` in Hz, or 30), with gaps where names skip numbers. Poses: ``poses.tum`` (or
        ``groundtruth.txt``), interpolated by time; or ``poses.kitti`` (or ``poses.txt``), one line per image.
    require_poses
        True leaves out images without a pose. False keeps all of them; there is a truth only if every one has a pose.
    focal_px
        Focal length where there is no ``camera-intrinsics.txt``; else that which EXIF says.
    """
    folder = Path(folder).resolve()
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; expected images")
    notes: list[Note] = []
    images = image_files(folder, notes)
    if not images:
        raise DatasetError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
    _refuse_kinds(folder, images)
    images, times = _times(folder, images, notes)
    camera = camera_beside(folder, common_size(images), None, notes, focal_px=focal_px, images=images)
    damaged: Damaged = {}
    poses = _poses(folder, times, damaged, notes)
    if require_poses and poses is None:
        raise DatasetError(f"{folder / _TUM[0]}: poses are missing (or {', '.join((*_TUM[1:], *_KITTI))})")
    table = FrameTable(folder.name, images, times, poses=poses, why=damaged, notes=notes)
    return table.sequence(camera, require_poses=require_poses)


def _poses(folder: Path, times: FloatArray, damaged: Damaged, notes: list[Note]) -> FloatArray | None:
    there = [name for name in POSE_FILES if (folder / name).is_file()]
    if len(there) > 1:
        notes.append(Note("other poses are not read", f"{folder}: {there[0]} is read, not {', '.join(there[1:])}"))
    for name in _TUM:
        if (folder / name).is_file():
            rows, why = paired_by_time(tum_table, folder / name, times, notes)
            damaged |= why
            return rows
    for path in (folder / name for name in _KITTI):
        if path.is_file():
            try:
                rows = kitti_table(path, damaged)
            except TrajectoryFileError as exc:
                hint = f" ({path.name} holds a 3x4 matrix a line; a file of time, position and quaternion is {_TUM[0]})"
                raise DatasetError(f"{exc}{hint if 'twelve numbers, got' in str(exc) else ''}") from exc
            if len(rows) != len(times):
                raise DatasetError(f"{path}: holds {len(rows)} poses, but there are {len(times)} images")
            return rows
    return None


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
            raise DatasetError(
                f"{folder}: holds images of two kinds, such as {names}, which {counted(len(both), 'number')} have in "
                "common; expected those of one camera"
            )


def _numbered_times(folder: Path, images: list[Path], notes: list[Note]) -> FloatArray:
    """Even times, with gaps where the names skip numbers."""
    even = even_times(folder, len(images))
    parts = [_NUMBERED.fullmatch(image.stem) for image in images]
    alike = {(match[1], match[3]) for match in parts if match is not None}
    if len(alike) != 1 or None in parts:
        return even
    numbers = np.array([int(match[2]) for match in parts if match is not None], dtype=np.float64)
    steps = np.diff(numbers)
    if len(images) < _FEW or steps.min() < 1 or steps.max() == 1:
        return even
    wide, usual = int(np.argmax(steps)), np.sort(steps)[(len(steps) - 1) // 2]  # the median, of steps that there are
    told = "times are even" if steps.min() == steps.max() else "times have gaps where numbers have"
    one = f"{counted(int(usual), 'number')} {'is' if usual == 1 else 'are'} one frame"
    where = f"{images[wide].name} is followed by {images[wide + 1].name}; {told}: {one}. Write others into times.txt"
    notes.append(Note("names skip numbers", f"{folder}: {where}"))
    return np.asarray(even[0] + (numbers - numbers[0]) / usual * (even[1] - even[0]))


def _times(folder: Path, images: list[Path], notes: list[Note]) -> tuple[list[Path], FloatArray]:
    """Times of images, and the images in their order where their names are times."""
    if (folder / "times.txt").is_file():
        return images, frame_times(folder, len(images))
    try:
        named = np.array([number(image.stem) for image in images])
        if (fractions := fractions_of([image.stem for image in images])) is not None and (named >= 0).all():
            named = fractions[0]
    except ValueError:
        named = np.array([np.nan])
    if not np.isfinite(named).all() or all(_DATE.match(image.stem) for image in images):
        return images, _numbered_times(folder, images, notes)
    if not (named > _SINCE_1970_S).all() and not all("." in image.stem for image in images):
        return images, _numbered_times(folder, images, notes)
    order = np.argsort(named, kind="stable")
    return [images[i] for i in order], named[order]
