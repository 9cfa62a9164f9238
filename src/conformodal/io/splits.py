"""Cutting a sequence into training, calibration and test parts.

``interleaved`` holds out frames at random: calibration and test frames are exchangeable, so coverage follows its
exact law, but a test frame's neighbours are in the training part. ``blocks`` holds out contiguous stretches:
harder, closer to use, and not exchangeable; coverage measured there is an observation, not a guarantee.
``recordings`` holds out whole recordings at random: recordings are exchangeable, frames are not. ``given`` tests on the
frames that the data set's own lists name: its authors chose them, so neither recordings nor frames are exchangeable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from math import ceil

import numpy as np

from conformodal.core.arrays import BoolArray, IntArray, rows_by_label
from conformodal.core.ranges import as_member, check_ranges, check_shares
from conformodal.core.words import counted

from .errors import SplitError

_BLOCKS = 25  # stretches that a sequence is cut into


class SplitKind(StrEnum):
    """Names of the splits."""

    INTERLEAVED = "interleaved"
    BLOCKS = "blocks"
    RECORDINGS = "recordings"
    GIVEN = "given"


@dataclass(frozen=True, eq=False)
class Split:
    """Sorted frame indices of the three parts, and how they were made."""

    kind: SplitKind
    seed: int
    train: IntArray
    calibration: IntArray
    test: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", as_member(self.kind, SplitKind, "split", SplitError))

    def part(self, name: str) -> IntArray:
        """Indices of ``"train"``, ``"calibration"`` or ``"test"``."""
        return {"train": self.train, "calibration": self.calibration, "test": self.test}[name]


def make_split(
    recording: IntArray,
    kind: SplitKind | str,
    *,
    seed: int = 0,
    test: float = 0.2,
    calibration: float = 0.16,
    used: float | None = None,
    given_test: BoolArray | None = None,
) -> Split:
    """Cut frames into parts.

    `recording` (n,) is the recording each frame belongs to; blocks do not span recordings. `test` and `calibration` are
    shares of all frames; for ``recordings``, of the recordings, and every part gets at least one. For ``given``, the
    frames that `given_test` (n,) does not name stand for the share ``1 - test``: whole recordings of them calibrate if
    there are two or more, otherwise stretches do. `used` is the share for training and calibration together; all but
    the test part by default, which is the same whatever it is. Where recordings are too few to leave some out, a
    stretch of each is taken.
    """
    kind = as_member(kind, SplitKind, "split", SplitError)
    check_ranges({"test": test, "calibration": calibration, "used": used, "seed": seed}, SplitError)
    check_shares(test, calibration, used, SplitError)
    free, listed = _pieces(recording, kind, given_test)
    if kind is SplitKind.RECORDINGS and len(free) < 3:
        raise SplitError(f"split recordings needs at least 3 recordings, one for each part; found {len(free)}")
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(free))
    given = kind is SplitKind.GIVEN
    whole = len(free) / (1 - test) if given else len(free)  # the lists' test frames are not among the free
    n_test, n_calibration = 0 if given else round(test * whole), round(calibration * whole)
    n_used = len(free) - n_test if used is None else round(used * whole)
    if given or kind is SplitKind.RECORDINGS:  # recordings are few: rounding must not leave a part empty
        n_test = 0 if given else min(max(n_test, 1), len(free) - 2)
        n_calibration = min(max(n_calibration, 1), len(free) - n_test - 1)
        n_used = len(free) - n_test if used is None else min(max(n_used, n_calibration + 1), len(free) - n_test)
    groups = np.split(order[: n_test + n_used], [n_test, n_test + n_calibration])
    chosen = [[free[i] for i in group] for group in groups]
    if used is not None and n_used > round(used * whole):  # the recordings are too few to leave some out
        chosen[1:] = [[_shortened(frames, used * whole / n_used, rng) for frames in group] for group in chosen[1:]]
    chosen[0] += listed
    if not all(chosen):
        pieces = f"{counted(len(recording), 'frame')} in {counted(len(free) + len(listed), 'piece')}"
        raise SplitError(f"{pieces}: too few for a {kind} split into three parts")
    parts = [np.sort(np.concatenate(pieces)) for pieces in chosen]
    return Split(kind, seed, train=parts[2], calibration=parts[1], test=parts[0])


def _shortened(frames: IntArray, share: float, rng: np.random.Generator) -> IntArray:
    n = max(1, round(share * len(frames)))
    start = int(rng.integers(len(frames) - n + 1))
    return frames[start : start + n]


def held_out_together(recording: IntArray, kind: SplitKind | str, given_test: BoolArray | None = None) -> IntArray:
    """Number (n,) of the piece of each frame: frames of one piece get into the same part of :func:`make_split`."""
    kind = as_member(kind, SplitKind, "split", SplitError)
    piece = np.empty(len(recording), dtype=np.int64)
    free, listed = _pieces(recording, kind, given_test)
    for number, frames in enumerate([*free, *listed]):
        piece[frames] = number
    return piece


def with_random_calibration(split: Split, share: float) -> Split:
    """The same test part, with a share of training and calibration part together drawn at random to calibrate.

    An ``interleaved`` split is drawn so already, and stays as it is.
    """
    if split.kind is SplitKind.INTERLEAVED:
        return split
    both = np.random.default_rng(split.seed).permutation(np.concatenate((split.train, split.calibration)))
    n = min(max(round(share * len(both)), 1), len(both) - 1)
    return replace(split, train=np.sort(both[n:]), calibration=np.sort(both[:n]))


def _pieces(
    recording: IntArray, kind: SplitKind, given_test: BoolArray | None
) -> tuple[list[IntArray], list[IntArray]]:
    """What is kept together: frames, stretches of one recording, or recordings; and what the lists name for testing."""
    frames = np.arange(len(recording))
    if kind is SplitKind.INTERLEAVED:
        return [np.array([i]) for i in frames], []
    if kind is SplitKind.BLOCKS:
        return _stretches(frames, recording), []
    if kind is SplitKind.RECORDINGS:
        return _recordings(frames, recording), []
    if given_test is None:
        raise SplitError("split given needs TrainSplit.txt and TestSplit.txt beside the folders seq-NN, or --test")
    free, listed = frames[~given_test], frames[given_test]
    whole = _recordings(free, recording)
    return whole if len(whole) > 1 else _stretches(free, recording), _recordings(listed, recording)


def _recordings(frames: IntArray, recording: IntArray) -> list[IntArray]:
    return [frames[rows] for rows in rows_by_label(recording[frames])]


def _stretches(frames: IntArray, recording: IntArray) -> list[IntArray]:
    size = max(1, ceil(len(frames) / _BLOCKS))
    runs = np.split(frames, np.flatnonzero((np.diff(frames) != 1) | (np.diff(recording[frames]) != 0)) + 1)
    return [run[a : a + size] for run in runs for a in range(0, len(run), size)]
