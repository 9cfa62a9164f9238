"""Calibration of regions: nonconformity scores of frames that no source has seen, and thresholds from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from conformodal.conformal import SplitConformal
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray, Rows, evenly_spread, rows_by_label
from conformodal.core.parallel import in_threads, in_workers, raise_if_cancelled
from conformodal.core.progress import stage_of
from conformodal.features.extract import extract_features
from conformodal.features.local import LocalFeatures, QualityRange
from conformodal.geometry import RelativeMotion
from conformodal.io import Disturbance
from conformodal.io.decoding import grey_image
from conformodal.localizer.carrying import CarrySettings, FeatureStream, StreamFrame
from conformodal.localizer.cells import divide_bins
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.localizer import Beliefs, Localizer
from conformodal.localizer.regions import EvidenceType, PlaceNovelty, RegionRules, pose_scores
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.training_data import TrainingData
from conformodal.tracking.motions import frame_features, turned_features

from .config import ModelConfig, OdometryError
from .folds import Folds
from .model import SourceComparison

_MAX_COMPARED = 120  # each is answered twice
_MAX_DISTURBED, _DISTURBED_SEED = 200, 0  # calibration frames, and the seed of kinds and strengths


def score_beliefs(rule: SplitConformal, localizer: Localizer, beliefs: Beliefs, targets: FloatArray) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7) under beliefs about n images."""
    supports, parts = localizer.supports(beliefs), localizer.marginals_by_part(beliefs)
    return np.concatenate([pose_scores(rule, proba, supports[rows], targets[rows]) for rows, proba in parts])


@dataclass(frozen=True, eq=False)
class CalibratedRegions:
    """What held-out frames calibrate: region rules and novelty test; and the beliefs about them, fold by fold."""

    rules: RegionRules
    novelty: PlaceNovelty | None
    beliefs: list[Beliefs]
    quality: QualityRange | None = None  # of the images that the sources know, if disturbed ones are calibrated


def calibrate_regions(
    data: TrainingData,
    folds: Folds,
    localizers: Sequence[Localizer],
    novelty: PlaceNovelty | None,
    config: ModelConfig,
    motions: dict[int, RelativeMotion | None],
    rooms: Rooms | None = None,
) -> CalibratedRegions:
    """Thresholds by evidence type, from one localizer per fold that learnt from the fold's training frames alone.

    `motions` are those between held-out frames; with `rooms`, each has thresholds of its own.
    """
    pairs = list(zip(folds.folds, localizers, strict=True))
    for fold, localizer in pairs:
        check_unseen(localizer, fold.held_out)
    local = all(localizer.local for localizer in localizers)
    carries = local and any(by.carrying_source is not None for by in localizers)
    if local and folds.units is not None and (carries or not data.detector.rotation_invariant):
        # where corners are followed, a place is as strongly recognised as when they were detected: the novelty test is
        # calibrated on how strongly it is in frames in which they are, as often as a run detects them there
        streams = [
            HeldOutStreams(data.with_features_of(fold.held_out), fold.held_out, by, carries=True) for fold, by in pairs
        ]
        streams += [one._replace(carries=False) for one in streams] if carries else []
        looked = in_workers(partial(beliefs_of_streams, folds.units, motions), streams)
        beliefs, detected = looked[: len(pairs)], looked[-len(pairs) :]
    else:
        asked = [_Asked(by, fold.held_out, _evidence(data, fold.held_out, local=local)) for fold, by in pairs]
        beliefs = detected = in_workers(_answer, asked)
    known_p = np.ones(len(folds.held_out))
    if novelty is not None:
        novelty, known_p = _novelty_of_held_out(novelty, folds, data, detected if local else None)
    # of the evidence type of unknown places, as such images will be
    known_p = np.where(
        np.concatenate([out_of_range(*pair) for pair in zip(localizers, beliefs, strict=True)]), 0, known_p
    )
    level = 0.0 if novelty is None else novelty.level(config.novelty_level)
    recognised = np.concatenate([one.recognised for one in beliefs]) if local else None
    units = None if folds.units is None else folds.units[folds.held_out]
    cells = divide_bins(data.bins_of(folds.region_frames), data.depth.median_m)
    rule = SplitConformal(cells, config.alpha, config.score, config.joint)
    scale: npt.ArrayLike = 1.0
    if getattr(rule.score_, "per_unit", False) and rule.joint == "max":
        # by the targets' spread, which does not depend on calibration frames
        scale = 1 / np.maximum(data.targets[folds.folds[0].train].std(axis=0), 1e-9)
    rule.set_scale(scale)
    scores = [
        score_beliefs(_on_cells(rule, localizer), localizer, one, data.targets[fold.held_out])
        for (fold, localizer), one in zip(pairs, beliefs, strict=True)
    ]
    overall = rule.calibrate_scores(np.concatenate(scores), units)
    in_rooms = None if rooms is None else rooms.rooms_of([mixture for one in beliefs for mixture in one.mixtures])
    rules = RegionRules(overall, recognised, known_p, level, rooms=in_rooms)
    return CalibratedRegions(rules, novelty, beliefs)


def _evidence(data: TrainingData, frames: IntArray, *, local: bool) -> FrameEvidence:
    return FrameEvidence(data.features[frames], data.local_features(frames) if local else ())


class HeldOutStreams(NamedTuple):
    """Frames that a localizer has not seen, to be looked at stretch by stretch."""

    data: TrainingData
    frames: IntArray
    localizer: Localizer
    # whether corners are followed; else frames are looked at by themselves, and after one in which a place was
    # recognised, those that come before a run would detect local features again have the same belief
    carries: bool


def beliefs_of_streams(units: IntArray, motions: dict[int, RelativeMotion | None], streams: HeldOutStreams) -> Beliefs:
    """The beliefs about held-out frames, each stretch looked at as a stream, see :class:`.carrying.FeatureStream`.

    Labels of stretches and motions from the frame before are of all frames.
    """
    data, held_out, localizer, carries = streams

    def of_stretch(rows: IntArray) -> list[Beliefs]:
        stream = FeatureStream(localizer, data.sequence.camera, data.detector, carries=carries)
        beliefs, looked_s = list[Beliefs](), -np.inf
        for frame in held_out[rows].tolist():
            raise_if_cancelled()
            time_s = float(data.sequence.timestamps_s[frame])
            is_soon = not carries and time_s - looked_s < CarrySettings().detect_every_s
            if is_soon and beliefs[-1].recognised[0]:
                stream.skip(motions[frame])
                beliefs.append(beliefs[-1])
                continue
            looked_s = time_s
            [upright] = data.local_features(np.array([frame]))
            grey = grey_image(data.sequence.image(frame))

            def detect(
                turn_rad: float, frame: int = frame, upright: LocalFeatures = upright
            ) -> Iterator[LocalFeatures]:
                turned = turn_rad != 0
                yield turned_features(data.sequence, frame, data.detector, turn_rad, upright) if turned else upright

            look = stream.look(StreamFrame(grey, time_s, motions[frame], upright.flow), detect)
            evidence = FrameEvidence(data.features[frame : frame + 1], [look.features], [look.estimates], look.busy)
            beliefs.append(localizer.beliefs(evidence))
            stream.observe(beliefs[-1].estimates[0])
        return beliefs

    stretches = rows_by_label(units[held_out])
    in_order = [one for part in in_threads(of_stretch, stretches) for one in part]
    return Beliefs.concatenate(in_order).part(np.argsort(np.concatenate(stretches)))


def out_of_range(localizer: Localizer, beliefs: Beliefs) -> BoolArray:
    """(n,) whether images are most probably from beyond the cells."""
    return np.array([support.out_of_range for support in localizer.supports(beliefs)], dtype=np.bool_)


def _novelty_of_held_out(
    novelty: PlaceNovelty, folds: Folds, data: TrainingData, beliefs: Sequence[Beliefs] | None
) -> tuple[PlaceNovelty, FloatArray]:
    """p-values of the calibration frames, and the test; with beliefs, the test of images with local features too."""
    held_out, test = folds.held_out, novelty.test
    if folds.units is None:
        distances = novelty.distances(_evidence(data, held_out, local=False))
        known_p = test.p_values(distances)
    else:  # each against the frames of other pieces; the frames that sources learn from are the last of the references
        at = np.searchsorted(folds.region_frames, held_out) - len(folds.region_frames)
        known_p, distances = test.left_out_p_values()[at], test.scores_[at]
    if beliefs is None:
        return novelty, known_p
    units = np.arange(len(held_out)) if folds.units is None else folds.units[held_out]
    recognition = np.concatenate([one.recognition for one in beliefs])
    matched = test.rescored(novelty.ranked(distances, recognition), units)
    return replace(novelty, matched=matched), matched.left_out_p_values()


class _Asked(NamedTuple):
    """Evidence of frames that a localizer is asked about."""

    localizer: Localizer
    frames: IntArray
    evidence: FrameEvidence


def _answer(asked: _Asked) -> Beliefs:
    return asked.localizer.beliefs(asked.evidence)


@dataclass(frozen=True, eq=False)
class _Disturbed(Rows):
    """Disturbed copies of held-out frames that are beyond the range of qualities."""

    scores: RealArray
    known_p: FloatArray
    units: IntArray


def calibrate_disturbed(
    data: TrainingData, folds: Folds, localizers: Sequence[Localizer], calibrated: CalibratedRegions
) -> CalibratedRegions:
    """Calibrate the evidence type of disturbed images, on copies of held-out frames that are disturbed at random.

    Those count whose quality is beyond that of all frames that the sources learn from. Without local features, or
    without such copies, nothing changes.
    """
    rules, novelty = calibrated.rules, calibrated.novelty
    if rules.recognised is None or novelty is None or novelty.matched is None:
        return calibrated
    quality = QualityRange.of(np.array([features.quality for features in data.local_features(folds.region_frames)]))
    sequence = replace(data.sequence, noise=Disturbance(_DISTURBED_SEED, data.sequence.noise))
    asked: list[_Asked] = []
    for fold, localizer in zip(folds.folds, localizers, strict=True):
        most = -(-_MAX_DISTURBED // len(folds.folds))
        frames = fold.held_out[:: -(-len(fold.held_out) // most)]
        copies = in_threads(partial(frame_features, sequence, detector=data.detector), frames.tolist())
        left = quality.is_outside(np.array([one.quality for one in copies]))
        if not left.any():
            continue
        frames, copies = frames[left], [one for one, counts in zip(copies, left, strict=True) if counts]
        paths, stage = [sequence.image_paths[i] for i in frames], stage_of(data.progress, "disturbed images")
        features = extract_features(paths, data.require_backbone(), data.cache, stage, sequence.noise)
        asked.append(_Asked(localizer, frames, FrameEvidence(features, copies)))
    parts: list[_Disturbed] = []
    for (localizer, frames, evidence), beliefs in zip(asked, in_workers(_answer, asked), strict=True):
        distances = novelty.distances(evidence, None if folds.units is None else folds.pieces[frames])
        known_p = np.where(beliefs.recognised, 1.0, novelty.matched.p_values(distances))
        parts.append(
            _Disturbed(
                score_beliefs(_on_cells(rules.overall, localizer), localizer, beliefs, data.targets[frames]),
                np.where(out_of_range(localizer, beliefs), 0.0, known_p),
                frames if folds.units is None else folds.units[frames],
            )
        )
    if not parts:
        return calibrated
    every = _Disturbed.concatenate(parts)
    rule = copy(rules.overall).calibrate_scores(every.scores, None if folds.units is None else every.units)
    return replace(calibrated, rules=replace(rules, disturbed=rule, disturbed_p=every.known_p), quality=quality)


def _on_cells(rule: SplitConformal, localizer: Localizer) -> SplitConformal:
    """A rule that scores the beliefs of a localizer, whose cells are its own."""
    scorer = copy(rule)
    scorer.bins = localizer.cells
    return scorer


def compare_sources(
    data: TrainingData,
    localizers: Sequence[Localizer],
    localizer: Localizer,
    novelty: PlaceNovelty | None,
    rules: RegionRules,
    frames: IntArray,
    rooms: Rooms | None = None,
) -> SourceComparison | None:
    """Compare scores of held-out frames by the model's localizer and by those of the folds, a share of frames each.

    Frames are looked at by themselves, upright. None if no frame shows a known place.
    """
    frames = frames[evenly_spread(len(frames), _MAX_COMPARED)]
    if frames.size == 0:
        return None

    def judged(one: _Asked, beliefs: Beliefs) -> _Judged:
        p = np.ones(len(one.frames)) if novelty is None else novelty.p_values(one.evidence, beliefs.recognition)
        rule, targets = _on_cells(rules.overall, one.localizer), data.targets[one.frames]
        scores, kinds = score_beliefs(rule, one.localizer, beliefs, targets), rules.kinds(p, beliefs.recognised)
        thresholds = rules.thresholds(kinds, None if rooms is None else rooms.rooms_of(beliefs.mixtures))
        held = np.asarray((scores <= thresholds).all(axis=1))
        return _Judged(held, rules.overall.columns(scores).mean(axis=1), kinds != EvidenceType.UNKNOWN)

    n, by_folds = len(localizers), list[_Asked]()
    for by, rows in zip(localizers, (np.arange(k, len(frames), n) for k in range(n)), strict=True):
        if rows.size:
            by_folds.append(_Asked(by, frames[rows], _evidence(data, frames[rows], local=rules.recognised is not None)))
    asked = [*by_folds, *(one._replace(localizer=localizer) for one in by_folds)]
    answers = [judged(*pair) for pair in zip(asked, in_workers(_answer, asked), strict=True)]
    other, model = _Judged.concatenate(answers[: len(by_folds)]), _Judged.concatenate(answers[len(by_folds) :])
    shown = model.shown
    if not shown.any():
        return None
    return SourceComparison(
        n_frames=int(shown.sum()),
        n_both=int((model.held & other.held & shown).sum()),
        n_model_only=int((model.held & ~other.held & shown).sum()),
        n_folds_only=int((~model.held & other.held & shown).sum()),
        larger=float((model.score > other.score)[shown].mean()),
    )


@dataclass(frozen=True, eq=False)
class _Judged(Rows):
    """Regions of n frames: whether they hold, the scores of the true poses, and whether a known place is shown."""

    held: BoolArray
    score: RealArray
    shown: BoolArray


def check_unseen(localizer: Localizer, held_out: IntArray) -> None:
    """Refuse sources that have seen calibration frames: their scores are too low, which voids the guarantee."""
    for source in localizer.sources:
        learnt = np.intersect1d(source.frames, held_out)
        if learnt.size:
            raise OdometryError(
                f"pose source {source.name!r} has seen frame {learnt[0]}, and {learnt.size} of the "
                f"{len(held_out)} frames in all that it is to be calibrated on; a source may look at the "
                "frames alone that its fit is given"
            )
