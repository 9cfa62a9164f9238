"""Folds of the calibration: frames or stretches that are held out from the sources that estimate them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from conformodal.conformal import conformal_rank
from conformodal.conformal.checks import Alpha
from conformodal.core.arrays import IntArray
from conformodal.core.ranges import as_member
from conformodal.io import Recording, Split, SplitKind, held_out_together

from .config import Calibration, ModelConfig, OdometryError

# Number of folds. Each needs a map, which takes most of the training time. On redkitchen `blocks` (seed 20) three
# gave the coverage and lengths of five; in a corridor of identical rooms (benchmarks/unseen.py, seed 20, stretches)
# regions had 2.80 m with three, 0.21 m with four and 0.19 m with five: sources that lack a third of the frames
# take one room for another
MAX_FOLDS = 4


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
    whole_recordings: bool = False  # whether units are recordings

    @property
    def held_out(self) -> IntArray:
        """The frames that calibrate, fold by fold."""
        return np.concatenate([fold.held_out for fold in self.folds])


def make_folds(
    sequence: Recording, split: Split, calibration: Calibration | str = Calibration.AUTO, alpha: Alpha = 0.1
) -> Folds:
    """The folds of a sequence's training and calibration parts; those of stretches are drawn with the split's seed.

    Whole recordings take the place of stretches where there are enough of them for a finite threshold at `alpha`.
    """
    calibration = as_member(calibration, Calibration, "calibration", OdometryError)
    by_frame = calibration is Calibration.AUTO and split.kind is SplitKind.INTERLEAVED
    if by_frame or calibration is Calibration.FRAMES:
        pieces = held_out_together(sequence.recording, split.kind, given_test=sequence.given_test)
        return Folds([Fold(split.train, split.calibration)], split.train, None, pieces)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    units = sequence.recording
    n_recordings = len(np.unique(units[used]))
    whole = conformal_rank(n_recordings, alpha) <= n_recordings
    if not whole:
        units = held_out_together(sequence.recording, SplitKind.BLOCKS)
    names, folds = np.random.default_rng(split.seed).permutation(np.unique(units[used])), []
    for part in np.array_split(names, min(MAX_FOLDS, len(names))):
        hidden = np.isin(units[used], part)
        folds.append(Fold(used[~hidden], used[hidden]))
    return Folds(folds, used, units, units, whole_recordings=whole)


def settings_record(config: ModelConfig, sequence: Recording, folds: Folds) -> dict[str, Any]:
    """Settings and data as a model stores them, without alpha and the novelty level, which can change later."""
    return {
        **{k: v for k, v in asdict(config).items() if k not in ("alpha", "novelty_level")},
        "method": str(config.method),
        "split": str(config.split),
        "calibrate_on": "frames" if folds.units is None else "stretches",
        "whole_recordings": folds.whole_recordings,
        "data": sequence.name,
        "n_frames": len(sequence),
        "unit": sequence.unit,
    }
