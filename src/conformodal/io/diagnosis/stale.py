"""Poses or pictures that repeat to the last bit while the other side moves: of a tracker or driver that has stopped.

A single repeat is no reason: cameras and poses of other rates have them. Repeats count where they last for longer than
a frame or 0.08 s, or where more than a quarter of all are repeats.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, UInt8Array, evenly_spread
from conformodal.core.words import counted
from conformodal.geometry import angle_between_quats
from conformodal.io.decoding import grey_image, read_image
from conformodal.io.errors import ImageError

from .flow import flow_px, tracked_corners

STALE_POSES, STALE_PICTURES = "poses repeat while the images move", "pictures repeat while the poses move"
_ROUNDING = 1e-12  # of poses that were interpolated between equal ones
_LONGER, _HELD_S, _OFTEN = 1.5, 0.08, 0.25  # frames, or seconds; share of all
_MAX_TRIED, _MAX_NAMED = 24, 3
_MOVED_PX = 2.0  # corners of images while poses stay
_MOVED_M, _MOVED_SHARE, _MOVED_DEG = 0.005, 0.005, 0.2  # poses while pictures stay; share of the box of all positions
_MOVED_ESTIMATE_M, _MOVED_ESTIMATE_DEG = 0.05, 2.0
_BLOCK = 4096
_GRID, _LEVELS, _CHANGED = 8, 3, 0.01  # every eighth pixel; grey levels; share of these that differ more


class StaleStretch(NamedTuple):
    """A value, its row, and the last row that repeats it."""

    first: int
    last: int

    @property
    def rows(self) -> slice:
        """All of it."""
        return slice(self.first, self.last + 1)


def stretches_of(repeats: BoolArray) -> list[StaleStretch]:
    """Stretches of rows (n,) that repeat the one before."""
    edges = np.diff(np.concatenate(([False], repeats, [False])).astype(np.int8))
    starts, ends = np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist()
    return [StaleStretch(start - 1, end - 1) for start, end in zip(starts, ends, strict=True)]


def repeated_poses(rows: FloatArray, recording: IntArray | None = None) -> BoolArray:
    """Which of the poses (n, 7), or of their parts, repeat the one before, in the same recording."""
    same = np.zeros(len(rows), dtype=np.bool_)
    if len(rows) > 1:
        same[1:] = (np.abs(np.diff(rows, axis=0)) <= _ROUNDING * np.maximum(1, np.abs(rows[1:]))).all(axis=1)
    if recording is not None:
        same[1:] &= np.diff(recording) == 0
    return same


def repeated_pictures(paths: Sequence[Path], recording: IntArray | None = None) -> BoolArray:
    """Which image files (n,) hold the same picture as the one before; decodes those alone of one size in bytes."""
    sizes = [os.stat(path).st_size if os.path.isfile(path) else -1 for path in paths]
    same = np.zeros(len(paths), dtype=np.bool_)
    for i in range(1, len(paths)):
        if sizes[i] == sizes[i - 1] >= 0 and (recording is None or recording[i] == recording[i - 1]):
            same[i] = _same_picture(paths[i - 1], paths[i], sizes[i])
    return same


def _same_picture(path: Path, other: Path, size: int) -> bool:
    with suppress(OSError, ImageError):
        with path.open("rb") as one, other.open("rb") as two:
            one.seek(size // 2), two.seek(size // 2)
            if one.read(_BLOCK) != two.read(_BLOCK):
                return False
        return path.read_bytes() == other.read_bytes() or np.array_equal(read_image(path), read_image(other))
    return False


def stale_poses(
    times_s: FloatArray,
    rows: FloatArray,
    frames_s: FloatArray,
    images: Sequence[Path],
    recording: IntArray | None = None,
) -> list[StaleStretch]:
    """Stretches of poses (n, 7), at times (n,), that repeat while images at times (m,) move; all in order of time.

    Images are read only where there are such poses.
    """
    if len(frames_s) < 2 or not (np.diff(frames_s) > 0).all():
        return []
    step_s = float(np.median(np.diff(frames_s)))
    likely = _that_last(repeated_poses(rows, recording), times_s, step_s)
    return _confirmed(likely, lambda stretch: _images_move(times_s[list(stretch)], frames_s, images))


def stale_truth(times_s: FloatArray, rows: FloatArray, estimate: FloatArray) -> list[StaleStretch]:
    """Stretches of poses (n, 7) that repeat while those of an estimate, of these times, move by more than noise."""
    likely = _that_last(repeated_poses(rows), times_s, float(np.median(np.diff(times_s))))
    return [
        one for one in likely if poses_move(estimate[one.first : one.last + 1], _MOVED_ESTIMATE_M, _MOVED_ESTIMATE_DEG)
    ]


def stale_pictures(
    paths: Sequence[Path], times_s: FloatArray, rows: FloatArray, recording: IntArray | None = None
) -> list[StaleStretch]:
    """Stretches of frames (n,) whose pictures repeat while their poses (n, 7) move."""
    repeats = repeated_pictures(paths, recording)
    if not repeats.any() or not (np.diff(times_s) > 0).all():
        return []
    posed = np.isfinite(rows).all(axis=1)
    box_m = float(np.linalg.norm(np.ptp(rows[posed, :3], axis=0))) if posed.any() else np.nan
    likely = _that_last(repeats, times_s, float(np.median(np.diff(times_s))))
    return [
        stretch
        for stretch in likely
        if poses_move(rows[stretch.first : stretch.last + 1], max(_MOVED_M, _MOVED_SHARE * box_m))
    ]


def poses_move(rows: FloatArray, moved_m: float, moved_deg: float = _MOVED_DEG) -> bool:
    """Whether the last of some poses (n, 7) is elsewhere than the first, or looks elsewhere; rows of NaN are none."""
    known = rows[np.isfinite(rows).all(axis=1)]
    if len(known) < 2:
        return False
    first, last = known[0], known[-1]
    turned_deg = float(np.degrees(angle_between_quats(first[None, 3:], last[None, 3:])[0]))
    return bool(np.linalg.norm(last[:3] - first[:3]) > moved_m or turned_deg > moved_deg)


def describe_stretches(name: str, what: str, stretches: list[StaleStretch], times_s: FloatArray, n: int) -> str:
    """How many of n poses or pictures repeat, and when."""
    stale = sum(stretch.last - stretch.first for stretch in stretches)
    longest = sorted(stretches, key=lambda one: times_s[one.first] - times_s[one.last])[:_MAX_NAMED]
    named = [f"{times_s[one.last] - times_s[one.first]:.3g} s from {times_s[one.first]:.3f}" for one in sorted(longest)]
    more = f" and {len(stretches) - len(named)} more" if len(stretches) > len(named) else ""
    return (
        f"{name}: {stale} of {counted(n, what)} ({100 * stale / n:.0f} %) repeat the one before to the last bit, in "
        f"{counted(len(stretches), 'stretch', 'stretches')}: {', '.join(named)}{more}"
    )


def _that_last(repeats: BoolArray, times_s: FloatArray, step_s: float) -> list[StaleStretch]:
    """Stretches that last, or all where repeats are many."""
    stretches = stretches_of(repeats)
    if repeats.mean() > _OFTEN:
        return stretches
    longest_s = min(_LONGER * step_s, _HELD_S)
    return [one for one in stretches if times_s[one.last] - times_s[one.first] > longest_s]


def _confirmed(stretches: list[StaleStretch], moves: Callable[[StaleStretch], bool | None]) -> list[StaleStretch]:
    """Stretches in which the other side moves; of many, some are tried, and the others are as most of these."""
    tried = {i: moves(stretches[i]) for i in evenly_spread(len(stretches), _MAX_TRIED)}
    known = [moved for moved in tried.values() if moved is not None]
    mostly = 2 * sum(known) > len(known)
    return [one for i, one in enumerate(stretches) if (mostly if (moved := tried.get(i)) is None else moved)]


def _images_move(span_s: FloatArray, frames_s: FloatArray, images: Sequence[Path]) -> bool | None:
    """Whether images move in a span of time; None where nobody can tell."""
    first, last = np.searchsorted(frames_s, span_s[0] - 1e-6), np.searchsorted(frames_s, span_s[1] + 1e-6) - 1
    share = 1.0
    if last <= first:  # the span lies between two frames, or shows one
        first = int(np.clip(np.searchsorted(frames_s, span_s.mean()) - 1, 0, len(frames_s) - 2))
        last = first + 1
        share = float(np.ptp(span_s) / (frames_s[last] - frames_s[first]))
    try:
        grey = [grey_image(read_image(images[i])) for i in (first, last)]
        moved_px = _flow(*grey)
        if moved_px is None and last > first + 1:
            moved_px = _flow(grey[0], grey_image(read_image(images[first + 1])))
    except ImageError:
        return None
    return None if moved_px is None else moved_px > _MOVED_PX and share * moved_px > _MOVED_PX / 2


def _flow(one: UInt8Array, other: UInt8Array) -> float | None:
    """By how many pixels corners usually move; infinite where nearly all are lost, None where there are none."""
    if one.shape != other.shape:
        return None
    pixels = tracked_corners(one, other)
    return None if pixels is None else flow_px(pixels)


class RepeatWatch:
    """Looks whether a stream's pictures repeat although the camera moved before."""

    def __init__(self) -> None:
        self._last: UInt8Array | None = None
        self._first_s, self._name, self._n_repeats = 0.0, "", 0
        self._moved = False  # whether the last two pictures that differ show a motion

    def check(self, image: UInt8Array, timestamp_s: float, name: str) -> str:
        """Why the next picture (h, w, 3) is not one of its time; nothing where it may be."""
        last = self._last
        if last is not None and _same_pixels(last, image):
            self._n_repeats += 1
            held_s = timestamp_s - self._first_s
            if self._moved and (self._n_repeats > 1 or held_s > _HELD_S):
                return (
                    f"{name}: repeats the picture of {self._name} to the last bit, {held_s:.2f} s later, and the "
                    "camera moved before: its driver seems to have stopped"
                )
            return ""
        if last is not None and last.shape == image.shape:
            few = [picture[::_GRID, ::_GRID].astype(np.int16) for picture in (last, image)]
            self._moved = bool((np.abs(few[0] - few[1]) > _LEVELS).mean() > _CHANGED)
        self._last, self._first_s, self._name, self._n_repeats = image, timestamp_s, name, 0
        return ""


def _same_pixels(one: UInt8Array, other: UInt8Array) -> bool:
    """Whether two pictures are equal, of which some rows tell first."""
    if one is other:
        return True
    if one.shape != other.shape or not np.array_equal(one[::64], other[::64]):
        return False
    return np.array_equal(one, other)
