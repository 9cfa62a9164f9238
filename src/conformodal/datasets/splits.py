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
    units = _units(np.arange(n), recording, kind, n_blocks)
    order = rng.permutation(len(units))
    n_test = round(test * len(units))
    n_calibration = round(calibration * len(units))
    n_used = len(units) - n_test if used is None else round(used * len(units))
    groups = np.split(order[: n_test + n_used], [n_test, n_test + n_calibration])
    if any(len(g) == 0 for g in groups):
        raise SplitError(f"{n} frames in {len(units)} pieces are too few for a {kind} split into three parts")
    parts = [np.sort(np.concatenate([units[u] for u in g])) for g in groups]
    return Split(kind, seed, train=parts[2], calibration=parts[1], test=parts[0])


def hold_out(
    frames: IntArray, recording: IntArray, kind: SplitKind, share: float, *, seed: int = 0, n_blocks: int = 25
) -> tuple[IntArray, IntArray]:
    """Cut a part once more: the frames that stay, and those held out in the manner of `kind`; both sorted.

    Parameters
    ----------
    frames
        Sorted indices.
    recording
        Of all frames.
    kind, seed, n_blocks
        As for :func:`make_split`; a block also ends where frames are missing.
    share
        To hold out, of the blocks or frames; at least one is, and at least one stays.

    Raises
    ------
    SplitError
        If there are fewer pieces than two.
    """
    units = _units(frames, recording, kind, n_blocks)
    if len(units) < 2:
        raise SplitError(f"{len(frames)} frames in {len(units)} pieces are too few to hold some out")
    order = np.random.default_rng(seed).permutation(len(units))
    n_held = min(max(1, round(share * len(units))), len(units) - 1)
    parts = (order[n_held:], order[:n_held])
    kept, held = (np.sort(np.concatenate([units[u] for u in part])) for part in parts)
    return kept, held


def _units(frames: IntArray, recording: IntArray, kind: SplitKind, n_blocks: int) -> list[IntArray]:
    """What is kept together: single frames, or stretches of one recording without gaps."""
    if kind is SplitKind.INTERLEAVED:
        return [np.array([i]) for i in frames]
    size = max(1, ceil(len(frames) / n_blocks))
    ends = np.flatnonzero((np.diff(recording[frames]) != 0) | (np.diff(frames) != 1)) + 1
    return [run[a : a + size] for run in np.split(frames, ends) for a in range(0, len(run), size)]
