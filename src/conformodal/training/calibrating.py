"""Calibration of regions: nonconformity scores of frames that no source has seen, and thresholds from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.calibration.joint import Joint, as_joint
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.scores import is_per_unit
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray
from conformodal.localization.belief import Beliefs, belief_cells
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.localizer import Localizer
from conformodal.localization.source_data import SourceData
from conformodal.model.comparison import SourceComparison
from conformodal.model.config import ModelConfig
from conformodal.model.errors import OdometryError
from conformodal.model.place_novelty import PlaceNovelty
from conformodal.model.region_rules import RegionRules

from .folds import Folds

_MOST_COMPARED = 120  # each is answered twice


def score_beliefs(rule: SplitConformal, localizer: Localizer, beliefs: Beliefs, targets: FloatArray) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7) under beliefs about n images."""
    parts = localizer.marginals_by_part(beliefs)
    return np.concatenate([rule.score_samples(proba, targets[rows]) for rows, proba in parts])


def calibrate_regions(
    data: SourceData, folds: Folds, localizers: Sequence[Localizer], novelty: PlaceNovelty | None, config: ModelConfig
) -> RegionRules:
    """Thresholds by evidence type, from one localizer per fold that learnt from the fold's training frames alone."""
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        _check_unseen(localizer, fold.held_out)
    held_out = folds.held_out
    units = None if folds.units is None else folds.units[held_out]
    # scores per unit of the target are scaled by its spread, which does not depend on calibration frames
    spread = np.maximum(data.targets[folds.folds[0].train].std(axis=0), 1e-9)

    def rule(cells: QuantileBins, joint: Joint) -> SplitConformal:
        made = SplitConformal(cells, config.alpha, config.score, joint)
        made.rule.keep_scale()
        if is_per_unit(made.score):
            made.rule.scale_ = 1 / spread
        return made

    asked = as_joint(config.joint)
    overall: list[RealArray] = []
    matched: list[RealArray] = []
    recognised: list[BoolArray] = []
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        frames = fold.held_out
        targets, own = data.targets[frames], rule(localizer.cells, asked)
        images = FrameEvidence(data.features[frames])
        overall.append(score_beliefs(own, localizer, localizer.beliefs(images), targets))
        if localizer.local:
            beliefs = localizer.beliefs(FrameEvidence(data.features[frames], data.local_features(frames)))
            matched.append(score_beliefs(own, localizer, beliefs, targets))
            recognised.append(beliefs.recognised)
    # with a fold without landmarks, beliefs with them cannot be calibrated
    local = len(matched) == len(localizers)
    cells = belief_cells(data.bins_of(folds.region_frames))
    places = np.concatenate(recognised) if local else np.zeros(len(held_out), dtype=bool)
    known_p = np.ones(len(held_out)) if novelty is None else _p_values(novelty, folds, data)

    def calibrated(joint: Joint) -> RegionRules:
        return RegionRules(
            overall=rule(cells, joint).calibrate_scores(np.concatenate(overall), units),
            matched=rule(cells, joint).calibrate_scores(np.concatenate(matched), units) if local else None,
            recognised=places,
            known_p=known_p,
            level=0.0 if novelty is None else novelty.level(config.novelty_level),
        )

    rules = calibrated(asked)
    return calibrated("max") if asked == "bonferroni" and _has_type_for_max_only(rules) else rules


def compare_sources(
    data: SourceData,
    localizers: Sequence[Localizer],
    localizer: Localizer,
    novelty: PlaceNovelty | None,
    rules: RegionRules,
    frames: IntArray,
) -> SourceComparison | None:
    """Compare scores of held-out frames by the model's localizer and by those of the folds, a share of frames each.

    None if no frame shows a known place.
    """
    frames = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), _MOST_COMPARED)).round().astype(int))]
    known_p = np.ones(len(frames)) if novelty is None else novelty.p_values(data.features[frames])

    def answered(own: Localizer, rows: IntArray) -> tuple[BoolArray, RealArray]:
        local = () if rules.matched is None else data.local_features(frames[rows])
        images = FrameEvidence(data.features[frames[rows]], local)
        beliefs = own.beliefs(images)
        scorer = SplitConformal(own.cells, rules.overall.alpha, rules.overall.score)
        scores = score_beliefs(scorer, own, beliefs, data.targets[frames[rows]])
        kinds = rules.kinds(known_p[rows], images.has_local_features, beliefs.recognised)
        held = np.asarray((scores <= rules.thresholds(kinds)).all(axis=1))
        return held, rules.overall.rule.columns(scores).mean(axis=1)

    n = len(frames)
    by_model, score = answered(localizer, np.arange(n))
    by_folds, other = np.empty(n, dtype=bool), np.empty(n)
    for k, own in enumerate(localizers):
        rows = np.arange(k, n, len(localizers))
        if rows.size:
            by_folds[rows], other[rows] = answered(own, rows)
    shown = known_p > rules.level
    if not shown.any():
        return None
    return SourceComparison(
        n_frames=int(shown.sum()),
        n_both=int((by_model & by_folds & shown).sum()),
        n_model_only=int((by_model & ~by_folds & shown).sum()),
        n_folds_only=int((~by_model & by_folds & shown).sum()),
        larger=float((score > other)[shown].mean()),
    )


def _check_unseen(localizer: Localizer, held_out: IntArray) -> None:
    """Refuse sources that have seen calibration frames: their scores are too low, which voids the guarantee."""
    for source in localizer.sources:
        seen = np.intersect1d(source.frames, held_out)
        if seen.size:
            raise OdometryError(
                f"pose source {source.name!r} has seen frame {seen[0]}, and {seen.size} of the "
                f"{len(held_out)} frames in all that it is to be calibrated on; a source may look at the "
                "frames alone that its fit is given"
            )


def paper_rules(data: SourceData, held_out: IntArray, localizer: Localizer, config: ModelConfig) -> RegionRules:
    """The paper's calibration (section 2): bins of the softmax, each target at alpha, one evidence type."""
    _check_unseen(localizer, held_out)
    proba = localizer.beliefs(FrameEvidence(data.features[held_out])).proba
    rule = SplitConformal(localizer.bins, config.alpha, config.score, as_joint(config.joint))
    n = len(held_out)
    return RegionRules(rule.calibrate(proba, data.targets[held_out]), None, np.zeros(n, dtype=bool), np.ones(n), 0.0)


def _has_type_for_max_only(rules: RegionRules) -> bool:
    """Whether an evidence type has the weight for a finite threshold at alpha, but not at each target's share of it.

    The choice depends on the weights of the types, never on scores. Where one more unit would change it, coverage can
    be below ``1 - alpha``, by at most alpha.
    """
    for_max = 1 / as_alpha(rules.overall.alpha) - 1
    for_each = 1 / rules.overall.alpha_per_target - 1
    return any(for_max <= rule.weight < for_each for rule in rules.own.values())


def _p_values(novelty: PlaceNovelty, folds: Folds, data: SourceData) -> FloatArray:
    """p-values of the calibration frames, each tested against the frames of other pieces."""
    if len(folds.folds) == 1:
        return novelty.p_values(data.features[folds.held_out])
    return novelty.test.left_out_p_values()[np.searchsorted(folds.region_frames, folds.held_out)]
