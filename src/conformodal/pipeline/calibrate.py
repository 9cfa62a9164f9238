"""Calibration of regions: nonconformity scores of frames that no source has seen, and thresholds from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import cast

import numpy as np

from conformodal.conformal import QuantileBins, SplitConformal, hierarchical_quantile
from conformodal.conformal.calibrators.base import Joint
from conformodal.conformal.checks import as_alpha
from conformodal.conformal.scores import is_per_unit
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray, evenly_spread, rows_by_label
from conformodal.core.parallel import in_threads, raise_if_cancelled
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.backbone import Backbone
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.image_quality import QualityRange
from conformodal.geometry import RelativeMotion
from conformodal.io import Disturbance, Recording
from conformodal.localizer.belief import Beliefs, belief_cells
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import Posterior, Window, filter_posteriors, hindsight_posteriors
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.novelty import PlaceNovelty
from conformodal.localizer.observations import Observations
from conformodal.localizer.places import choose_places, same_place
from conformodal.localizer.prior import MotionPrior
from conformodal.localizer.region_rules import EvidenceType, RegionRules, part_of
from conformodal.localizer.regions import pose_scores
from conformodal.localizer.settings import FILTER
from conformodal.localizer.sources.registry import SourceData
from conformodal.tracking.flow import frame_features

from .config import ModelConfig
from .errors import OdometryError
from .folds import Folds
from .model import HINDSIGHT, LAGGED, ONLINE, PATHS, SourceComparison, path_rule

_MOST_COMPARED = 120  # each is answered twice
_MOST_DISTURBED, _DISTURBED_SEED = 200, 0  # calibration frames, and the seed of kinds and strengths


def score_beliefs(rule: SplitConformal, localizer: Localizer, beliefs: Beliefs, targets: FloatArray) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7) under beliefs about n images."""
    supports, parts = localizer.supports(beliefs), localizer.marginals_by_part(beliefs)
    return np.concatenate([pose_scores(rule, proba, supports[rows], targets[rows]) for rows, proba in parts])


@dataclass(frozen=True, eq=False)
class Calibrated:
    """What held-out frames calibrate: region rules and novelty test; and the beliefs about them, fold by fold."""

    rules: RegionRules
    novelty: PlaceNovelty | None
    beliefs: list[Beliefs]


def calibrate_regions(
    data: SourceData,
    folds: Folds,
    localizers: Sequence[Localizer],
    novelty: PlaceNovelty | None,
    config: ModelConfig,
) -> Calibrated:
    """Thresholds by evidence type, from one localizer per fold that learnt from the fold's training frames alone.

    ``bonferroni`` becomes ``max`` where only one threshold for the whole pose would be finite.
    """
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        _check_unseen(localizer, fold.held_out)
    held_out = folds.held_out
    units = None if folds.units is None else folds.units[held_out]
    local = all(its.local for its in localizers)

    def rule(cells: QuantileBins, joint: Joint) -> SplitConformal:
        made = SplitConformal(cells, config.alpha, config.score, joint)
        if not is_per_unit(made.score_) or joint != "max":
            return made.set_scale()
        # by the targets' spread, which does not depend on calibration frames
        return made.set_scale(1 / np.maximum(data.targets[folds.folds[0].train].std(axis=0), 1e-9))

    asked = cast(Joint, config.joint)
    joints: list[Joint] = [asked, "max"] if asked == "bonferroni" else [asked]
    scores: dict[Joint, list[RealArray]] = {joint: [] for joint in joints}
    found: list[Beliefs] = []
    beyond: list[bool] = []
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        frames = fold.held_out
        beliefs = localizer.beliefs(FrameEvidence(data.features[frames], data.local_features(frames) if local else ()))
        for joint, its in scores.items():
            its.append(score_beliefs(rule(localizer.cells, joint), localizer, beliefs, data.targets[frames]))
        beyond += [its.out_of_range for its in localizer.supports(beliefs)]
        found.append(beliefs)
    cells = belief_cells(data.bins_of(folds.region_frames))
    known_p = np.ones(len(held_out))
    if novelty is not None:
        known_p, distances = _appearance(novelty, folds, data)
        if local:
            recognition = np.concatenate([its.recognition for its in found])
            matched = novelty.calibrated(distances, recognition, np.arange(len(held_out)) if units is None else units)
            novelty, known_p = replace(novelty, matched=matched), matched.left_out_p_values()
    known_p = np.where(beyond, 0.0, known_p)  # of the evidence type of unknown places, as such images will be
    level = 0.0 if novelty is None else novelty.level(config.novelty_level)
    recognised = np.concatenate([its.recognised for its in found]) if local else None

    def calibrated(joint: Joint) -> RegionRules:
        own = rule(cells, joint).calibrate_scores(np.concatenate(scores[joint]), units)
        return RegionRules(own, recognised, known_p, level)

    rules = calibrated(asked)
    rules = calibrated("max") if len(joints) > 1 and _has_type_for_max_only(rules) else rules
    return Calibrated(rules, novelty, found)


def calibrate_disturbed(
    data: SourceData,
    backbone: Backbone,
    cache: FeatureCache,
    folds: Folds,
    localizers: Sequence[Localizer],
    calibrated: Calibrated,
    progress: StageProgress | None = None,
) -> tuple[Calibrated, QualityRange | None]:
    """Calibrate the evidence type of disturbed images, on copies of held-out frames that are disturbed at random.

    Those count whose quality is beyond that of all frames that the sources learn from. Without local features, or with
    too few copies, nothing changes.
    """
    rules, novelty = calibrated.rules, calibrated.novelty
    if rules.recognised is None or novelty is None:
        return calibrated, None
    known = data.local_features(folds.region_frames)
    quality = QualityRange.of(np.array([its.quality for its in known]))
    sequence = replace(data.sequence, noise=Disturbance(_DISTURBED_SEED, data.sequence.noise))
    found: list[tuple[RealArray, FloatArray, BoolArray, IntArray]] = []  # scores, novelty, out of range, units
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        most = -(-_MOST_DISTURBED // len(folds.folds))
        frames = fold.held_out[:: -(-len(fold.held_out) // most)]
        copies = in_threads(partial(frame_features, sequence), frames.tolist())
        left = quality.left_by(np.array([its.quality for its in copies]))
        if not left.any():
            continue
        frames, copies = frames[left], [its for its, counts in zip(copies, left, strict=True) if counts]
        paths, stage = [sequence.image_paths[i] for i in frames], stage_of(progress, "disturbed images")
        features = extract_features(paths, backbone, cache, stage, sequence.noise)
        evidence = FrameEvidence(features, copies)
        beliefs = localizer.beliefs(evidence)
        scorer = copy(rules.overall)
        scorer.bins = localizer.cells
        scores = score_beliefs(scorer, localizer, beliefs, data.targets[frames])
        pieces = None if folds.units is None else folds.pieces[frames]
        beyond = np.array([its.out_of_range for its in localizer.supports(beliefs)])
        ranked = novelty.ranked(novelty.distances(evidence, pieces), beliefs.recognition)
        found.append((scores, ranked, beyond, frames if folds.units is None else folds.units[frames]))
    if not found:
        return calibrated, None
    scores, ranked, beyond, units = (np.concatenate(its) for its in zip(*found, strict=True))
    test = novelty.test.rescored(ranked, np.arange(len(scores)) if folds.units is None else units)
    if 0 < rules.level < test.least_p:  # so few that none could be flagged as unknown
        return calibrated, None
    rule = copy(rules.overall).calibrate_scores(scores, None if folds.units is None else units)
    rules = replace(rules, disturbed=rule, disturbed_p=np.where(beyond, 0.0, novelty.disturbed_p(test)))
    return replace(calibrated, rules=rules, novelty=replace(novelty, disturbed=test)), quality


def calibrate_paths(
    sequence: Recording,
    targets: FloatArray,
    folds: Folds,
    localizers: Sequence[Localizer],
    calibrated: Calibrated,
    prior: MotionPrior,
    motions: dict[int, RelativeMotion | None],
) -> tuple[dict[str, SplitConformal], float]:
    """Thresholds of regions from posteriors: held-out frames are run as streams, one per fold, unit and recording.
    `motions` are those between held-out frames.

    Also the probability of a place from which its pose counts as reliable: a frame with a wrong place that is at least
    as probable, and whose region misses the pose, is as rare as the settings of the filter ask, or as so few units can
    show.

    Regions at the lag of a stream are calibrated on some frames of each, drawn at random among those that so many
    follow: as many of each stretch, or in proportion to their number where frames calibrate.

    Where stretches calibrate, this is exact for a new stretch that is run from its first frame. Where frames do, the
    streams of calibration and test frames differ in their gaps, so the guarantee is approximate.
    """
    rules = calibrated.rules
    units = sequence.recording if folds.units is None else folds.units
    known = rules.known if rules.recognised is None else rules.known | rules.recognised
    # by path, of each fold: scores, whether each posterior is lost, and rows among the held-out frames
    answered: dict[str, list[tuple[RealArray, BoolArray, IntArray]]] = {path: [] for path in PATHS}
    truth, n = sequence.require_truth(), len(folds.held_out)
    wrong = np.full(n, -np.inf)  # probabilities of wrong places online
    start, rng = 0, np.random.default_rng(0)
    n_streams = sum(len(np.unique(units[fold.held_out])) for fold in folds.folds)
    for fold, localizer, own in zip(folds.folds, localizers, calibrated.beliefs, strict=True):
        rule, held_out = path_rule(localizer.cells, rules.overall.alpha), fold.held_out
        found: dict[str, dict[int, Posterior]] = {path: {} for path in PATHS}
        for at in rows_by_label(units[held_out]):
            moved, times = [motions[frame] for frame in held_out[at].tolist()], sequence.timestamps_s[held_out[at]]
            candidates = [own.mixtures[i].candidates for i in at.tolist()]
            seen = Observations(candidates, moved, times, known=known[start + at])
            forward = filter_posteriors(seen, prior)
            found[ONLINE].update(zip(at.tolist(), forward, strict=True))
            found[HINDSIGHT].update(zip(at.tolist(), hindsight_posteriors(seen, prior, forward), strict=True))
            drawn = FILTER.lagged / n_streams if folds.units is not None else FILTER.lagged * len(at) / n
            some = rng.permutation(max(len(at) - FILTER.lag, 0))[: math.ceil(drawn)]
            windows = {int(at[k]): slice(k, k + FILTER.lag + 1) for k in some.tolist()}
            found[LAGGED] |= {i: Window(seen.part(k), forward[k]).first(prior) for i, k in windows.items()}
            best, probability = choose_places(forward, times, prior)
            true = truth[held_out[at]]
            right = same_place(best, true.positions_xyz, true.orientations_quat_wxyz, prior)
            wrong[start + at] = np.where(right, -np.inf, probability)
            raise_if_cancelled()
        for path, posteriors in found.items():
            if not posteriors:
                continue
            which = np.array(sorted(posteriors))
            its = [posteriors[i] for i in which.tolist()]
            after = own.part(which).after(its)
            supports = localizer.supports(after)
            lost = np.array([one.lost or of.out_of_range for one, of in zip(its, supports, strict=True)])
            scores = score_beliefs(rule, localizer, after, targets[held_out[which]])
            answered[path].append((scores, lost, start + which))
        start += len(held_out)
    return _thresholds(rules.overall, answered, wrong)


def _thresholds(
    overall: SplitConformal,
    answered: dict[str, list[tuple[RealArray, BoolArray, IntArray]]],
    wrong: FloatArray,
) -> tuple[dict[str, SplitConformal], float]:
    """What :func:`calibrate_paths` gives, from the answers of the folds and the probabilities (n,) of wrong places."""
    labels, paths, reliable_p = overall.units_, {}, FILTER.reliable
    for path, parts in answered.items():
        if not parts:
            continue
        scores, lost, rows = (np.concatenate(its) for its in zip(*parts, strict=True))
        own_labels = None if labels is None else labels[rows]
        rule = path_rule(overall.bins, overall.alpha).calibrate_scores(scores, own_labels)
        paths[path] = part_of(rule, ~lost)
        if path == ONLINE:
            held = (scores <= paths[path].thresholds_).all(axis=1) | lost
            reliable_p = _reliable_p(np.where(held, -np.inf, wrong), labels)
    return paths, reliable_p


def _reliable_p(wrong: FloatArray, labels: IntArray | None) -> float:
    """From the probabilities (n,) of places of held-out frames: of wrong ones whose region misses, -inf of others."""
    unit = np.unique(np.arange(len(wrong)) if labels is None else labels, return_inverse=True)[1]
    streams = [wrong[unit == k] for k in range(unit.max() + 1)]
    least = hierarchical_quantile(streams, max(Fraction(FILTER.sure_and_wrong), Fraction(1, len(streams) + 1)))
    return min(max(FILTER.reliable, float(np.nextafter(least, 2.0))), FILTER.most_reliable)


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
    frames = frames[evenly_spread(len(frames), _MOST_COMPARED)]

    def answered(own: Localizer, rows: IntArray) -> tuple[BoolArray, RealArray, BoolArray]:
        local = () if rules.recognised is None else data.local_features(frames[rows])
        images = FrameEvidence(data.features[frames[rows]], local)
        beliefs, p = own.beliefs(images), np.ones(len(rows))
        if novelty is not None:
            p = novelty.p_values(images, beliefs.recognition)
        scorer = copy(rules.overall)
        scorer.bins = own.cells
        scores = score_beliefs(scorer, own, beliefs, data.targets[frames[rows]])
        kinds = rules.kinds(p, beliefs.recognised)
        held = np.asarray((scores <= rules.thresholds(kinds)).all(axis=1))
        return held, rules.overall.columns(scores).mean(axis=1), kinds != EvidenceType.UNKNOWN

    n = len(frames)
    by_model, score, shown = answered(localizer, np.arange(n))
    by_folds, other = np.empty(n, dtype=bool), np.empty(n)
    for k, own in enumerate(localizers):
        rows = np.arange(k, n, len(localizers))
        if rows.size:
            by_folds[rows], other[rows], _ = answered(own, rows)
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
    rule = SplitConformal(localizer.bins, config.alpha, config.score, cast(Joint, config.joint))
    rule.calibrate(proba, data.targets[held_out])
    return RegionRules(rule, None, np.ones(len(held_out)), 0.0)


def _has_type_for_max_only(rules: RegionRules) -> bool:
    """Whether an evidence type has the weight for a finite threshold at alpha, but not at each target's share of it.

    The choice depends on the weights of the types, never on scores. Where one more unit would change it, coverage can
    be below ``1 - alpha``, by at most alpha.
    """
    for_max = 1 / as_alpha(rules.overall.alpha) - 1
    for_each = 1 / rules.overall.alpha_per_target - 1
    return any(for_max <= rule.weight < for_each for rule in rules.by_type.values())


def _appearance(novelty: PlaceNovelty, folds: Folds, data: SourceData) -> tuple[FloatArray, FloatArray]:
    """p-values of the calibration frames by appearance, each against the frames of other pieces, and distances."""
    if folds.units is None:
        distances = novelty.distances(FrameEvidence(data.features[folds.held_out]))
        return novelty.test.p_values(distances), distances
    # the frames that the sources learn from are the last of the references
    at = np.searchsorted(folds.region_frames, folds.held_out) - len(folds.region_frames)
    return novelty.test.left_out_p_values()[at], novelty.test.scores_[at]
