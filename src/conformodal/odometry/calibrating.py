"""Calibrating regions: scores of frames by sources that did not see them, and thresholds from these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, SplitConformal, conformal_rank
from conformodal.conformal.calibration import Joint, as_joint
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.scores import is_per_unit
from conformodal.reasoning import fix_cells, pool_fixes

from .config import ModelConfig
from .folds import Fold, Folds
from .known import KnownPlaces
from .region_rules import RegionRules, trusted
from .scene import Scene
from .targets import TARGET_NAMES
from .training_data import TrainingData

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class FoldPrediction:
    """What the head of a fold says of the frames that were held out from it.

    Attributes
    ----------
    fold
        Which frames.
    bins
        Of the head.
    proba
        Seven arrays (m, K_j), of the held-out frames.
    """

    fold: Fold
    bins: QuantileBins
    proba: list[FloatArray]


def bins_of(data: TrainingData, rows: IntArray, config: ModelConfig) -> QuantileBins:
    """Bins of the targets of some frames."""
    return QuantileBins(config.n_bins, config.margin).fit(data.targets[rows])


def calibrate_regions(
    data: TrainingData,
    folds: Folds,
    predictions: Sequence[FoldPrediction],
    scene: Scene,
    known: KnownPlaces | None,
    config: ModelConfig,
) -> RegionRules:
    """Thresholds for each kind of evidence.

    Parameters
    ----------
    data, folds, config
        As in training.
    predictions
        One a fold.
    scene
        Learnt with the same folds.
    known
        Places that the region's sources know; None where nothing can be told.
    """
    held_out, landmarks = folds.held_out, scene.region_landmarks is not None
    units = None if folds.units is None else folds.units[held_out]
    joint = choose_joint(config, len(held_out) if units is None else len(np.unique(units)))
    # scores per unit of the target are compared in units of its spread, which no calibration frame chose
    spread = np.maximum(data.targets[folds.folds[0].train].std(axis=0), 1e-9)

    def rule(bins: QuantileBins) -> SplitConformal:
        made = SplitConformal(bins, config.alpha, config.score, joint)
        made.rule.keep_scale()
        if is_per_unit(made.score):
            made.rule.scale_ = 1 / spread
        return made

    softmax_scores, pooled_scores, start = [], [], 0
    for part in predictions:
        targets, end = data.targets[part.fold.held_out], start + len(part.fold.held_out)
        softmax_scores.append(rule(part.bins).score_samples(part.proba, targets))
        if landmarks:
            cells, fixes = fix_cells(part.bins), scene.calibration_fixes[start:end]
            pooled = pool_fixes(part.proba, fixes, part.bins, cells, data.sign_reference)
            pooled_scores.append(rule(cells).score_samples(pooled, targets))
        start = end
    bins = bins_of(data, folds.region_frames, config)
    p_values = np.ones(len(held_out)) if known is None else _p_values(known, folds, data)
    return RegionRules(
        softmax=rule(bins).calibrate_scores(np.concatenate(softmax_scores), units),
        pooled=rule(fix_cells(bins)).calibrate_scores(np.concatenate(pooled_scores), units) if landmarks else None,
        matched=trusted(scene.calibration_fixes) if landmarks else np.zeros(len(held_out), dtype=bool),
        known_p=p_values,
        level=0.0 if known is None else known.level(config.novelty_level),
    )


def choose_joint(config: ModelConfig, n_units: int) -> Joint:
    """What is asked for; one threshold for the whole pose where there are too few frames for one each.

    Parameters
    ----------
    config
        Says alpha and what is asked for.
    n_units
        Frames that calibrate, or stretches where these do.
    """
    joint, rate = as_joint(config.joint), as_alpha(config.alpha)
    enough = conformal_rank(n_units, rate / len(TARGET_NAMES)) <= n_units
    if joint == "bonferroni" and not enough and conformal_rank(n_units, rate) <= n_units:
        return "max"
    return joint


def _p_values(known: KnownPlaces, folds: Folds, data: TrainingData) -> npt.NDArray[np.float64]:
    """Of the frames that calibrate, each without its own piece."""
    if len(folds.folds) == 1:
        return known.p_values(data.features[folds.held_out])
    return known.test.left_out_p_values()[np.searchsorted(folds.region_frames, folds.held_out)]
