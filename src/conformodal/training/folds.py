"""Folds of the calibration: frames or stretches that are held out from the sources that estimate them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.conformal import conformal_rank
from conformodal.conformal.checks import Alpha
from conformodal.core.arrays import IntArray
from conformodal.core.ranges import as_member
from conformodal.datasets import Sequence, Split, SplitKind, held_out_together
from conformodal.model.config import Calibration
from conformodal.model.errors import OdometryError

from .settings import FOLDS


@dataclass(frozen=True, eq=False)
class Fold:
    """Frames that sources learn from, and held-out frames that these sources estimate."""

    train: IntArray
    held_out: IntArray


@dataclass(frozen=True, eq=False)
class Folds:
    """All folds, and the labels (n,) of all frames."""

    folds: list[Fold]  # one where frames calibrate
    region_frames: IntArray  # that the model's own sources learn from
    units: IntArray | None  # exchangeable units; None where every held-out frame is one
    pieces: IntArray  # frames of one piece are held out together in the novelty test

    @property
    def held_out(self) -> IntArray:
        """The frames that calibrate, fold by fold."""
        return np.concatenate([fold.held_out for fold in self.folds])


def make_folds(
    sequence: Sequence, split: Split, calibration: Calibration | str = Calibration.AUTO, alpha: Alpha = 0.1
) -> Folds:
    """The folds of a sequence's training and calibration parts; those of stretches are drawn with the split's seed.

    Whole recordings take the place of stretches where there are enough of them for a finite threshold at `alpha`.
    """
    calibration = as_member(calibration, Calibration, "calibration", OdometryError)
    if calibration is Calibration.AUTO:
        by_frame = split.kind is SplitKind.INTERLEAVED
        calibration = Calibration.FRAMES if by_frame else Calibration.STRETCHES
    if calibration is Calibration.FRAMES:
        pieces = held_out_together(sequence.recording, split.kind, given_test=sequence.given_test)
        return Folds([Fold(split.train, split.calibration)], split.train, None, pieces)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    units = sequence.recording
    n_recordings = len(np.unique(units[used]))
    if conformal_rank(n_recordings, alpha) > n_recordings:
        units = held_out_together(sequence.recording, SplitKind.BLOCKS)
    names = np.random.default_rng(split.seed).permutation(np.unique(units[used]))
    folds = []
    for part in np.array_split(names, min(FOLDS.most, len(names))):
        hidden = np.isin(units[used], part)
        folds.append(Fold(used[~hidden], used[hidden]))
    return Folds(folds, used, units, units)
