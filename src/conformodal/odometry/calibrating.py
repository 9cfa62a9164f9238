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
from conformodal.poses import PoseFix
from conformodal.reasoning import fix_cells, pool_fixes

from .config import ModelConfig
from .data import TrainingData
from .errors import OdometryError
from .folds import Fold, Folds
from .known import KnownPlaces
from .region_rules import RegionRules, trusted
from .scene import Scene
from .targets import TARGET_NAMES

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What a head says of the frames of a fold that it did not see.

    Attributes
    ----------
    fold
        Frames that the head learnt from, and those asked.
    bins
        Of the head.
    proba
        Seven arrays (m, K_j), of the frames asked.
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
    held_out: Sequence[HeldOut],
    scene: Scene,
    known: KnownPlaces | None,
    config: ModelConfig,
) -> RegionRules:
    """Thresholds for each kind of evidence.

    Parameters
    ----------
    data, folds, config
        As in training.
    held_out
        One a fold.
    scene
        Its fixes are of the frames asked, fold by fold.
    known
        Places that the region's sources know; None where nothing can be told.

    Raises
    ------
    OdometryError
        If the scene was learnt with other folds.
    """
    asked = folds.asked
    if scene.region_landmarks is not None and not np.array_equal(scene.asked, asked):
        raise OdometryError(
            f"the scene has answers to {len(scene.asked)} frames, and {len(asked)} others calibrate; learn the scene "
            "with the same folds"
        )
    units = None if folds.units is None else folds.units[asked]
    joint = choose_joint(config, len(asked) if units is None else len(np.unique(units)))
    bins = bins_of(data, folds.region_frames, config)
    scores = [_rule(part.bins, config, joint, part, data).score_samples(*_of(part, data)) for part in held_out]
    # where several parts answer, the scales of the first are as good as any: they only balance the targets
    softmax = _rule(bins, config, joint, held_out[0], data).calibrate_scores(np.concatenate(scores), units)
    pooled, matched = None, np.zeros(len(asked), dtype=bool)
    if scene.region_landmarks is not None:
        scores, done = [], 0
        for part in held_out:
            fixes = scene.calibration_fixes[done : done + len(part.fold.asked)]
            scores.append(_pooled_scores(part, fixes, data, config, joint, held_out[0]))
            done += len(fixes)
        pooled = _rule(fix_cells(bins), config, joint, held_out[0], data)
        pooled.calibrate_scores(np.concatenate(scores), units)
        matched = trusted(scene.calibration_fixes)
    if known is None:
        return RegionRules(softmax, pooled, matched, np.ones(len(asked)), 0.0)
    p_values = _p_values(known, folds, data)
    return RegionRules(softmax, pooled, matched, p_values, known.level(config.novelty_level))


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


def _rule(bins: QuantileBins, config: ModelConfig, joint: Joint, scale: HeldOut, data: TrainingData) -> SplitConformal:
    rule = SplitConformal(bins, config.alpha, config.score, joint)
    rule.rule.keep_scale()
    if rule.score.name in ("density", "linear_density"):
        # these have the units of their targets; any scale that the calibration did not choose will do
        rule.rule.scale_ = 1 / np.maximum(data.targets[scale.fold.known].std(axis=0), 1e-9)
    return rule


def _of(part: HeldOut, data: TrainingData) -> tuple[list[FloatArray], npt.NDArray[np.float64]]:
    return part.proba, data.targets[part.fold.asked]


def _pooled_scores(
    part: HeldOut,
    fixes: Sequence[Sequence[PoseFix]],
    data: TrainingData,
    config: ModelConfig,
    joint: Joint,
    scale: HeldOut,
) -> FloatArray:
    cells = fix_cells(part.bins)
    pooled = pool_fixes(part.proba, fixes, part.bins, cells, data.sign_reference)
    return _rule(cells, config, joint, scale, data).score_samples(pooled, data.targets[part.fold.asked])


def _p_values(known: KnownPlaces, folds: Folds, data: TrainingData) -> npt.NDArray[np.float64]:
    """Of the frames that calibrate, each without what is new together with it."""
    if len(folds.folds) == 1:
        return known.p_values(data.features[folds.asked])
    return known.test.left_out_p_values()[np.searchsorted(folds.region_frames, folds.asked)]
