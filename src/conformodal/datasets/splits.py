"""Cutting a sequence into training, calibration and test parts.

``interleaved`` holds out frames at random: calibration and test frames are exchangeable, so coverage follows its
exact law, but a test frame's neighbours are in the training part. ``blocks`` holds out contiguous stretches:
harder, closer to use, and not exchangeable; coverage measured there is an observation, not a promise.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import ceil

import numpy as np
import numpy.typing as npt

from .errors import SplitError

IntArray = npt.NDArray[np.int64]


class SplitKind(StrEnum):
    """Names of the splits."""

    INTERLEAVED = "interleaved"
    BLOCKS = "blocks"


@dataclass(frozen=True, eq=False)
class Split:
    """Sorted frame indices of the three parts, and how they were made."""

    kind: SplitKind
    seed: int
    train: IntArray
    calibration: IntArray
    test: IntArray

    def part(self, name: str) -> IntArray:
        """Indices of ``"train"``, ``"calibration"`` or ``"test"``."""
        if name not in ("train", "calibration", "test"):
            raise SplitError(f"part must be train, calibration or test, got {name!r}")
        indices: IntArray = getattr(self, name)
        return indices


def make_split(
    recording: IntArray,
    kind: SplitKind | str,
    *,
    seed: int = 0,
    test: float = 0.2,
    calibration: float = 0.16,
    used: float | None = None,
    n_blocks: int = 25,
) -> Split:
    """Cut frames into parts.

    Parameters
    ----------
    recording
        (n,) the recording each frame belongs to; blocks do not span recordings.
    kind
        ``"interleaved"`` or ``"blocks"``.
    seed
        Of the random choice of frames or blocks.
    test, calibration
        Shares of all frames.
    used
        Share of all frames for training and calibration together; all but the test part by default. The test part is
        the same whatever it is.
    n_blocks
        Number of stretches that ``blocks`` cuts the sequence into.

    Raises
    ------
    SplitError
        If a share is not positive, shares exceed the whole, or a part would be empty.
    """
    n = len(recording)
    try:
        kind = SplitKind(kind)
    except ValueError:
        raise SplitError(f"split must be one of {[str(k) for k in SplitKind]}, got {kind!r}") from None
    if not (test > 0 and calibration > 0 and test + calibration < 1):
        raise SplitError(f"test ({test}) and calibration ({calibration}) must be positive shares that leave training")
    if used is not None and not calibration < used <= 1 - test + 1e-9:
        raise SplitError(
            f"used ({used}) must be more than calibration ({calibration}), and with test ({test}) at most 1"
        )
    rng = np.random.default_rng(seed)
    units = _units(recording, kind, n_blocks)
    order = rng.permutation(len(units))
    n_test = round(test * len(units))
    n_calibration = round(calibration * len(units))
    n_used = len(units) - n_test if used is None else round(used * len(units))
    groups = np.split(order[: n_test + n_used], [n_test, n_test + n_calibration])
    if any(len(g) == 0 for g in groups):
        raise SplitError(f"{n} frames in {len(units)} pieces are too few for a {kind} split into three parts")
    parts = [np.sort(np.concatenate([units[u] for u in g])) for g in groups]
    return Split(kind, seed, train=parts[2], calibration=parts[1], test=parts[0])


def held_out_together(recording: IntArray, kind: SplitKind, n_blocks: int = 25) -> IntArray:
    """Number (n,) of each frame's piece: frames of one piece get into the same part of a split.

    Parameters
    ----------
    recording, kind, n_blocks
        As for :func:`make_split`.
    """
    piece = np.empty(len(recording), dtype=np.int64)
    for number, unit in enumerate(_units(recording, kind, n_blocks)):
        piece[unit] = number
    return piece


def _units(recording: IntArray, kind: SplitKind, n_blocks: int) -> list[IntArray]:
    """What is kept together: single frames, or stretches of one recording."""
    frames = np.arange(len(recording))
    if kind is SplitKind.INTERLEAVED:
        return [np.array([i]) for i in frames]
    size = max(1, ceil(len(frames) / n_blocks))
    runs = np.split(frames, np.flatnonzero(np.diff(recording) != 0) + 1)
    return [run[a : a + size] for run in runs for a in range(0, len(run), size)]
