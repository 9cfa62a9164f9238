"""Folds of the calibration: frames or stretches that are held out from the sources which estimate them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.conformal import conformal_rank
from conformodal.conformal.checks import Alpha
from conformodal.core.arrays import IntArray
from conformodal.core.choices import as_member
from conformodal.datasets import Sequence, Split, SplitKind, held_out_together
from conformodal.model.config import Calibration
from conformodal.model.errors import OdometryError
from conformodal.model.settings import FOLDS


@dataclass(frozen=True, eq=False)
class Fold:
    """Frames that sources learn from, and held-out frames that these sources then estimate."""

    train: IntArray
    held_out: IntArray


@dataclass(frozen=True, eq=False)
class Folds:
    """All folds, with what is exchangeable.

    Attributes
    ----------
    folds
        One for ``frames``.
    region_frames
        Frames that the sources of the region itself learn from.
    units
        (n,) labels of all frames: what is exchangeable; None where every held-out frame is.
    pieces
        (n,) labels of all frames: frames of one piece are held out together in the novelty test.
    """

    folds: list[Fold]
    region_frames: IntArray
    units: IntArray | None
    pieces: IntArray

    @property
    def held_out(self) -> IntArray:
        """The frames that calibrate, fold by fold."""
        return np.concatenate([fold.held_out for fold in self.folds])


def make_folds(
    sequence: Sequence, split: Split, calibration: Calibration | str = Calibration.AUTO, alpha: Alpha = 0.1
) -> Folds:
    """The folds of a sequence; those of stretches are drawn with the split's seed.

    Parameters
    ----------
    sequence, split
        Of whose training and calibration parts they are made.
    calibration
        See :class:`Calibration`.
    alpha
        Miscoverage rate: recordings calibrate where there are enough of them for a finite threshold at it.

    Raises
    ------
    OdometryError
        If `calibration` is not one of :class:`Calibration`.
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
