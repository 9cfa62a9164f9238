"""A trained and calibrated pose model: from an image's features to its belief and its region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import sqrt
from typing import Any, Self

import cv2
import numpy as np
from scipy.special import gammaincinv

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.conformal.scores import Aps
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray, UInt8Array, evenly_spread
from conformodal.core.ranges import check_ranges
from conformodal.core.words import counted
from conformodal.features.backbone import Backbone
from conformodal.features.local import ORB, Detector, QualityRange
from conformodal.geometry import PinholeCamera
from conformodal.io import Recording, Split, SplitKind
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.localizer import Beliefs, Localizer
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior, Posterior
from conformodal.localizer.regions import (
    EvidenceType,
    PlaceNovelty,
    PoseRegions,
    RegionRules,
    Support,
    pose_regions,
    pose_scores,
    supported_regions,
)
from conformodal.localizer.rooms import NoveltyLimits, Rooms
from conformodal.localizer.sources.landmarks import LandmarkSource

from .config import Method, OdometryError
from .identity import FrameIdentities

# What posteriors rest on: the frames up to each (online), or all frames of its recording (hindsight).
PATHS = ONLINE, HINDSIGHT = "online", "hindsight"
# Methods that give a trajectory. The first is the answer of a run.
METHODS = "smoothed", HINDSIGHT, ONLINE
PAPERS_METHOD = "greedy"
RELIABLE = 0.9  # least probability of the chosen place with which a pose counts as reliable
_SIGMAS = 2  # standard errors that a comparison of sources allows
_SAMPLED = 64  # training images whose colours are looked at
_COLOURS = 21  # bins of red less blue, as a share of their sum with green


@dataclass(frozen=True, eq=False)
class ExpectedInput:
    """The usual step in time of training frames, and the distribution of their colours."""

    step_s: float
    colours: FloatArray  # (21,) shares of pixels by red less blue, sum 1

    @classmethod
    def of(cls, recording: Recording) -> Self:
        """From all times, and some images."""
        steps = np.diff(recording.timestamps_s)[np.diff(recording.recording) == 0]
        sampled = evenly_spread(len(recording), _SAMPLED).tolist()
        colours = np.mean([colours_of(recording.image(i)) for i in sampled], axis=0)
        return cls(float(np.median(steps)) if steps.size else 1.0, colours)


def colours_of(image: UInt8Array) -> FloatArray:
    """Shares (21,) of an image's pixels by red less blue."""
    small = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).reshape(-1, 3).astype(np.float64)
    red_less_blue = (small[:, 0] - small[:, 2]) / np.maximum(small.sum(axis=1), 1.0)
    counts = np.histogram(red_less_blue, bins=_COLOURS, range=(-0.5, 0.5))[0]
    return np.asarray(counts / len(small))


def path_rule(cells: QuantileBins, alpha: Alpha) -> SplitConformal:
    """The rule of regions from posteriors, yet to be calibrated: all targets together."""
    rule = SplitConformal(cells, alpha, "hpd", "max")
    rule.set_scale()
    return rule


@dataclass(frozen=True, eq=False)
class PathRule:
    """The calibration of regions from posteriors."""

    calibration: SplitConformal
    # from a calibration frame to the nearest whose image shows a known place: posteriors beyond are not calibrated
    longest_gap_s: float
    # (n,) squared errors of the pose of each calibration frame over the covariance of its posterior
    squared: FloatArray
    known_p: FloatArray  # (n,) p-values of the images of calibration frames; 0 of those out of range
    level: float  # significance level: images with p-values of at most this are novel
    rooms: IntArray  # (n,) room of each calibration frame by its posterior; 0 where there is one

    def thresholds(self, novel: BoolArray, rooms: IntArray) -> RealArray:
        """(m, 7) thresholds of posteriors, from (m,) whether their image is novel and their rooms (m,).

        Through unknown parts errors grow, and the regions of the other frames need not hold them.
        """
        return self._limits(novel, rooms)

    @property
    def novel(self) -> BoolArray:
        """(n,) whether the image of each calibration frame is novel."""
        return np.asarray(self.known_p <= self.level)

    @cached_property
    def _limits(self) -> NoveltyLimits:
        return NoveltyLimits.of(self.calibration, self.novel, self.rooms)

    def variance_factors(self, novel: BoolArray, rooms: IntArray) -> FloatArray:
        """Factors (m,) of covariances with which the ellipsoid of 1 - alpha of a normal error is a conformal set.

        Its squared errors over the covariance are below the quantile of the chi-squared law with six degrees of
        freedom. Frames that are lost neither calibrate it nor are covered by it. Where all frames are too few for a
        finite quantile, it is as large as the largest error of those alike in novelty asks, at least 1, and without a
        guarantee.
        """
        if not len(self.squared):
            return np.ones(len(novel))
        normal = float(2 * gammaincinv(3, 1 - float(as_alpha(self.calibration.alpha))))
        factors = self._squared_limits(novel, rooms)[:, 0] / normal
        if not np.isfinite(factors).all():
            alike = [self.squared[self.novel == kind] for kind in novel]
            largest = [(own if own.size else self.squared).max(initial=normal) / normal for own in alike]
            factors = np.where(np.isfinite(factors), factors, largest)
        return factors.astype(np.float64)

    @cached_property
    def _squared_limits(self) -> NoveltyLimits:
        """Thresholds of squared errors as scores."""
        rule, n_targets = self.calibration, self.calibration.bins.n_targets
        sizes = () if rule.units_ is None else (rule.units_, rule.unit_sizes_)
        scores = np.repeat(self.squared[:, None], n_targets, axis=1)
        of_squared = path_rule(rule.bins, rule.alpha).calibrate_scores(scores, *sizes)
        return NoveltyLimits.of(of_squared, self.novel, self.rooms)


@dataclass(frozen=True)
class SourceComparison:
    """Held-out frames answered twice: by the sources of the model, and by sources of the folds, each without one fold.

    Calibration by stretches assumes that the scores of both are alike. Smaller errors of the model's sources are not
    enough: if their predicted spread is too small, their scores are larger, and their regions contain too few poses.
    """

    n_frames: int  # frames that neither had seen and that show a known place
    # frames whose pose is contained in both regions, in that of the model's sources only, in the other only
    n_both: int
    n_model_only: int
    n_folds_only: int
    larger: float  # share of frames in which the model's sources have the larger score

    @property
    def covered(self) -> tuple[float, float]:
        """Share of poses in the regions of the model's sources, and in those of the folds' sources."""
        held = self.n_both + self.n_model_only, self.n_both + self.n_folds_only
        return held[0] / self.n_frames, held[1] / self.n_frames

    @property
    def overconfident(self) -> bool:
        """Whether the model's regions contain fewer poses, by more than two standard errors of independent frames."""
        return self.n_folds_only - self.n_model_only > _SIGMAS * sqrt(self.n_folds_only + self.n_model_only)

    def describe(self) -> str:
        """The comparison in a sentence."""
        model, folds = self.covered
        return (
            f"In {counted(self.n_frames, 'held-out frame')} the regions of the model's sources hold {model:.3f} of the "
            f"poses, those of sources that lacked a fold of the stretches {folds:.3f}; the scores of the former are "
            f"larger in {100 * self.larger:.0f} %"
        )


@dataclass(frozen=True)
class JournalEntry:
    """A recording that joined a model later, and how the model answered it before it had seen it.

    One without poses joined the map alone, with its reliable frames: what true poses tell is None.
    """

    name: str
    date: str  # on which it joined, ISO 8601
    n_frames: int
    coverage: float | None  # of the regions of images
    bounded: float  # share of these that are bounded
    path_coverage: float | None  # of the regions from all frames until then; None where the model has none
    path_bounded: float | None
    reliable: float  # share of the frames that are called reliable
    median_m: float | None  # error of the position, online
    first_unit: int  # label of its first calibration unit; the others follow
    n_units: int  # 0 without poses

    def describe(self) -> str:
        """The entry in a line."""
        head, bounded = f"{self.date} {self.name}: {counted(self.n_frames, 'frame')}", f"{100 * self.bounded:.0f} %"
        if self.coverage is None or self.median_m is None:
            n = round(self.reliable * self.n_frames)
            return (
                f"{head}, no poses: joined the map alone, with {n} reliable frames ({100 * self.reliable:.0f} %); the "
                f"other {self.n_frames - n} joined nothing; before, {bounded} of the regions were bounded"
            )
        path = "" if self.path_coverage is None else f" (with motion {100 * self.path_coverage:.1f} %)"
        return (
            f"{head}, before it joined: regions held {100 * self.coverage:.1f} %{path}, {bounded} bounded, "
            f"{100 * self.reliable:.0f} % reliable, median error {self.median_m:.3f}"
        )


@dataclass(frozen=True, eq=False)
class Localization:
    """Beliefs and calibrated regions of n images, each by itself."""

    beliefs: Beliefs
    regions: PoseRegions
    known_p: FloatArray  # (n,) p-values of "this image shows a known place"; NaN where images are not tested
    kinds: IntArray  # (n,) evidence types, see :class:`~conformodal.localizer.regions.EvidenceType`
    rooms: IntArray  # (n,) room of each by its belief, see :class:`~conformodal.localizer.rooms.Rooms`; 0 in one room

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Those of all images, in order."""
        beliefs = Beliefs.concatenate([part.beliefs for part in parts])
        regions = PoseRegions.concatenate([part.regions for part in parts])
        names = "known_p", "kinds", "rooms"
        known_p, kinds, rooms = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
        return cls(beliefs, regions, known_p, kinds, rooms)

    @property
    def candidates(self) -> Sequence[PoseMixture]:
        """The hypotheses of each belief."""
        return self.beliefs.mixtures

    @property
    def known(self) -> BoolArray:
        """(n,) whether each image shows a known place."""
        return np.asarray((self.kinds != EvidenceType.UNKNOWN) | self.beliefs.recognised)


@dataclass(eq=False)
class PoseModel:
    """A trained and calibrated model; ``examples/stream.py`` runs one."""

    backbone: Backbone  # image to features
    # evidence to belief. Its pose sources have not seen the calibration frames; where stretches calibrate, the sources
    # of the folds have not
    localizer: Localizer
    novelty: PlaceNovelty | None  # test of images against the frames that the sources know
    rules: RegionRules  # belief to region: calibrated thresholds by evidence type
    prior: MotionPrior
    camera: PinholeCamera  # of the training images
    split: Split  # training, calibration and test frames
    known_frames: FrameIdentities  # of all frames of the training data, in the order of `split`
    expected_input: ExpectedInput
    # settings except alpha and the novelty level, which can change; see :attr:`settings`
    configuration: dict[str, Any] = field(default_factory=dict)
    comparison: SourceComparison | None = None  # where stretches calibrate
    # posterior to region: the calibration of each of :data:`PATHS`; empty where no motion was measured
    path_rules: dict[str, PathRule] = field(default_factory=dict)
    # of the images that the sources know; images beyond are disturbed. None where disturbed ones are not calibrated
    quality: QualityRange | None = None
    detector: Detector = ORB  # of local features
    rooms: Rooms | None = None  # each with thresholds of its own; None where all frames are of one room
    journal: tuple[JournalEntry, ...] = ()  # of recordings that joined after training, in their order

    def __post_init__(self) -> None:
        if self.looks_at_local_features and not self.localizer.local:
            raise OdometryError("the calibration is that of beliefs with local features, and no source uses them")
        if self.landmarks is not None:
            given, expected = self.landmarks.map.descriptors, self.detector.nothing.descriptors
            if given.dtype != expected.dtype or given.shape[1:] != expected.shape[1:]:
                raise OdometryError(f"the landmarks are not described by the local features {self.detector.name!r}")

    @property
    def method(self) -> Method:
        """Whether the model is this project's system or the paper's."""
        return Method(self.configuration.get("method", Method.CONFORMODAL))

    @property
    def frames_are_exchangeable(self) -> bool:
        """Whether test frames are to those that calibrate: drawn with them, and answered by the same sources."""
        return self.split.kind is SplitKind.INTERLEAVED

    @property
    def alpha(self) -> float:
        """Miscoverage rate of the regions."""
        return float(self.rules.overall.alpha)

    @property
    def settings(self) -> dict[str, Any]:
        """All current settings, as stored with results."""
        return {**self.configuration, "alpha": self.alpha, "novelty_level": float(self.rules.level)}

    @property
    def bins(self) -> QuantileBins:
        """Bins of the seven targets."""
        return self.localizer.bins

    @property
    def sign_reference(self) -> FloatArray:
        """(4,) quaternion that fixes the signs of quaternions."""
        return self.localizer.sign_reference

    @property
    def journal_with_poses(self) -> list[JournalEntry]:
        """The recordings that joined after training and calibrate, in their order."""
        return [entry for entry in self.journal if entry.n_units]

    @property
    def calibration(self) -> SplitConformal:
        """Calibration on the frames of all evidence types together."""
        return self.rules.overall

    @property
    def n_calibration(self) -> int:
        """Number of calibration frames."""
        return len(self.calibration.scores_)

    @property
    def looks_at_local_features(self) -> bool:
        """Whether local features of an image are used."""
        return self.rules.recognised is not None

    @property
    def follows_streams(self) -> bool:
        """Whether images are turned by the roll that was followed so far, and corners carried from frame to frame.

        Not where random frames calibrate: these are looked at one by one, without those before.
        """
        return self.calibration.units_ is not None

    @property
    def landmarks(self) -> LandmarkSource | None:
        """The source by PnP on landmarks, or None."""
        return next((one for one in self.localizer.sources if isinstance(one, LandmarkSource)), None)

    def localize(self, evidence: FrameEvidence) -> Localization:
        """Beliefs and calibrated regions of n images."""
        if not self.looks_at_local_features:  # beliefs with local features are not calibrated then
            evidence = FrameEvidence(evidence.network)
        elif not evidence.local_features:
            raise OdometryError("the model looks at local features, and the images come without")
        beliefs, p = self.localizer.beliefs(evidence), np.full(len(evidence), np.nan)
        disturbed: BoolArray | bool = False
        if self.quality is not None and evidence.local_features:
            disturbed = self.quality.is_outside(evidence.quality)
        if self.novelty is not None:
            p = self.novelty.p_values(evidence, beliefs.recognition)
        kinds = self.rules.kinds(p, beliefs.recognised, disturbed)
        supports = self.localizer.supports(beliefs)
        kinds[[support.out_of_range for support in supports]] = EvidenceType.UNKNOWN
        rooms = self._rooms_of(beliefs)
        return Localization(beliefs, self.image_regions(beliefs, kinds, supports), p, kinds, rooms)

    def _rooms_of(self, beliefs: Beliefs) -> IntArray:
        """(n,) the room of each belief."""
        if self.rooms is None:
            return np.zeros(len(beliefs), dtype=np.int64)
        return self.rooms.rooms_of(beliefs.mixtures)

    def scores(self, beliefs: Beliefs, targets: FloatArray) -> RealArray:
        """Nonconformity scores (n, 7) of targets (n, 7) under beliefs about n images, as those that calibrate."""
        supports, parts = self.localizer.supports(beliefs), self.localizer.marginals_by_part(beliefs)
        rule = self.calibration
        return np.concatenate([pose_scores(rule, proba, supports[rows], targets[rows]) for rows, proba in parts])

    def image_regions(
        self, beliefs: Beliefs, kinds: IntArray, supports: Sequence[Support] | None = None
    ) -> PoseRegions:
        """Regions of n images, each by itself, from their evidence types (n,), at the miscoverage rate in force.

        `supports` are those of the beliefs, where they were computed before.
        """
        thresholds = self.rules.thresholds(kinds, self._rooms_of(beliefs))
        supports = self.localizer.supports(beliefs) if supports is None else supports
        return self._level_sets(self.rules.overall, beliefs, supports, thresholds)

    def _level_sets(
        self, rule: SplitConformal, beliefs: Beliefs, supports: Sequence[Support], thresholds: RealArray
    ) -> PoseRegions:
        """Level sets of n beliefs at thresholds (n, 7) of the score."""
        if len(beliefs) == 1 and type(rule.score_) is Aps:  # as for each frame of a stream
            near = self.localizer.level_set(beliefs, rule.score_, thresholds[0])
            if near is not None:
                return supported_regions(rule, near, supports, thresholds)
        chunks = self.localizer.marginals_by_part(beliefs)
        parts = [pose_regions(rule, proba, supports[rows], thresholds[rows]) for rows, proba in chunks]
        return parts[0] if len(parts) == 1 else PoseRegions.concatenate(parts)

    def path_regions(self, answers: Localization, posteriors: Sequence[Posterior], path: str) -> PoseRegions | None:
        """Regions of n images from posteriors, unbounded where these are lost, or most probably beyond the cells, or
        where no image shows a known place for longer than in the streams that calibrate them.

        Few disturbed and weakly recognised images calibrate paths: their thresholds are at least those of the image
        alone. `path`, one of :data:`PATHS`, says what posteriors rest on; None where these are not calibrated.
        """
        rule = self.path_rules.get(path)
        if rule is None:
            return None
        after = answers.beliefs.after(posteriors)
        supports = self.localizer.supports(after)
        lost = [
            posterior.lost or posterior.unseen_s > rule.longest_gap_s or support.out_of_range
            for posterior, support in zip(posteriors, supports, strict=True)
        ]
        of_path = rule.thresholds(self.novel(answers), self._rooms_of(after))
        alone = self.rules.thresholds(answers.kinds, answers.rooms)
        harder = np.isin(answers.kinds, (EvidenceType.DISTURBED, EvidenceType.WEAK))[:, None] & np.isfinite(alone)
        if self.rules.overall.score == rule.calibration.score:  # shares of the belief, as those of paths are
            of_path = np.where(harder, np.maximum(alone, of_path), of_path)
        thresholds = np.where(np.array(lost)[:, None], np.inf, of_path)
        return self._level_sets(rule.calibration, after, supports, thresholds)

    def novel(self, answers: Localization) -> BoolArray:
        """(n,) whether images are novel: p is at most the level, also where a place is recognised, or out of range."""
        return np.asarray((answers.known_p <= self.rules.level) | (answers.kinds == EvidenceType.UNKNOWN))

    def variance_factor(self, answer: Localization, posterior: Posterior) -> float:
        """The factor of the covariance of a posterior about an image, see :meth:`PathRule.variance_factors`."""
        rule = self.path_rules.get(ONLINE)
        if rule is None:
            return 1.0
        rooms = np.zeros(1, np.int64) if self.rooms is None else self._rooms_of(answer.beliefs.after([posterior]))
        return float(rule.variance_factors(self.novel(answer), rooms)[0])

    def recalibrate(self, alpha: Alpha) -> None:
        """Change the miscoverage rate, from the stored calibration scores."""
        self.rules = self.rules.at(alpha)
        self.path_rules = {
            path: replace(rule, calibration=rule.calibration.at(alpha)) for path, rule in self.path_rules.items()
        }

    def set_novelty_level(self, level: float) -> None:
        """Flag images whose p-value is at most `level` as unknown; at 0, none."""
        check_ranges({"novelty_level": level}, OdometryError)
        self.rules = replace(self.rules, level=0.0 if self.novelty is None else self.novelty.level(level))
        self.path_rules = {path: replace(rule, level=self.rules.level) for path, rule in self.path_rules.items()}

    def check_camera(self, camera: PinholeCamera, tolerance: float = 1e-3) -> None:
        """Refuse images of another camera; intrinsics may differ by `tolerance` times the image's width."""
        cameras = self.camera, camera
        # a file may leave out distortion coefficients that are zero
        mine, other = ((c.width, c.height, *c.distortion, *[0.0] * (5 - len(c.distortion))) for c in cameras)
        one, another = (np.array([c.fx, c.fy, c.cx, c.cy]) for c in cameras)
        if mine != other or np.abs(one - another).max() > tolerance * self.camera.width:
            raise OdometryError(f"the model was trained with {self.camera}, the source has {camera}")

    def same_unit(self, recording: Recording) -> bool:
        """Whether the lengths of a recording are in the model's unit; also of one without poses."""
        return recording.poses is None or recording.unit == self.configuration["unit"]

    def check_unit(self, recording: Recording) -> None:
        """Refuse a recording whose poses are in another unit."""
        if not self.same_unit(recording):
            here, there = recording.unit, self.configuration["unit"]
            raise OdometryError(f"{recording.name}: has lengths in {here}, and the model in {there}; scale one")
