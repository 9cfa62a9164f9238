"""Calibrated regions of poses, by what they rest on: the cuboids of a product set that hypotheses support.

Sets of single targets, multiplied, have cuboids that no evidence speaks for: the x of one room beside the y of another.
Of the product at level q only those cuboids stay that contain one of the hypotheses which together hold q of the
belief. These sets are nested in q, so the score of a pose is the smallest q whose set contains it, and split-conformal
calibration guarantees their coverage as that of any other score.

Thresholds differ by evidence type (Mondrian calibration, Vovk et al. 2003); whether an image shows a known place is a
conformal novelty test on the network's features.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal import NoveltyTest, QuantileBins, Regions, SplitConformal
from conformodal.conformal.checks import Alpha, BinProbabilities, as_alpha
from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, RealArray
from conformodal.features.backbone import coarse_features
from conformodal.geometry import fix_sign

from .evidence import FrameEvidence
from .mixtures import PoseMixture
from .observations import Place, mean_of
from .rooms import part_of, thresholds_by_group

# Default significance levels of the novelty test, where single frames were left out and where stretches or recordings
# were: the probability that an image of a known place is flagged. Chosen on corridors with seeds 20 to 22. With K
# stretches no p-value is below 1 / (K + 1), so a lower level would flag nothing.
_LEVEL_FRAMES, LEVEL_STRETCHES = 0.015, 0.1


@dataclass(frozen=True, eq=False)
class Support:
    """The hypotheses of one image that can support a cuboid, most probable first."""

    mixture: PoseMixture  # the whole belief
    rows: IntArray  # (m,) hypotheses within the cells
    cells: IntArray  # (m, 7) cell of each target
    levels: FloatArray  # (m,) level of the region from which each counts: the probability of all that are more probable
    within: float = 1.0  # probability of the cells: the rest lies where no training frame was, or is turned as none was

    @property
    def out_of_range(self) -> bool:
        """Whether the image is most probably from beyond the cells."""
        return self.within < 0.5

    @classmethod
    def of(cls, mixture: PoseMixture, cells: QuantileBins, sign_reference: FloatArray) -> Self:
        """Of an image's hypotheses, without those beyond the cells."""
        order = np.argsort(-mixture.log_weights, kind="stable")
        quats = fix_sign(mixture.orientations_quat_wxyz, sign_reference)
        codes = cells.encode(np.concatenate((mixture.positions_xyz, quats), axis=1))[order]
        weights = mixture.weights[order]
        within = np.flatnonzero((codes >= 0).all(axis=1))
        levels = np.concatenate(([0.0], np.cumsum(weights)[:-1]))
        return cls(mixture, order[within], codes[within], levels[within], float(weights[within].sum()))


class PoseRegions(Regions):
    """Regions of n poses: disjoint cuboids, not the product of the targets' sets.

    The sets of single targets, such as :meth:`intervals` and `masks`, are the projections of the cuboids.
    """

    def __init__(self, sets: Regions, supports: Sequence[Support], limits: RealArray, *, product: bool = False) -> None:
        """From the product of the targets' sets, the hypotheses of each image, and the levels (n,) up to which they
        count.

        With `product`, the region is all of the product, as where each target is calibrated by itself. Its places are
        still the cuboids that hypotheses support.
        """
        super().__init__(sets.bins, sets.masks, sets.unbounded)
        self.supports, self.product = list(supports), product
        self.boxes: list[IntArray] = []  # (b, 7, 2): first cell and one past the last
        projections = [np.zeros_like(mask) for mask in self.masks]
        for i, (support, limit) in enumerate(zip(self.supports, limits, strict=True)):
            boxes = _supported(super().runs(i), support, limit)
            self.boxes.append(boxes)
            for box in boxes.tolist():
                for mask, (low, high) in zip(projections, box, strict=True):
                    mask[i, low:high] = True
        if not product:
            for mask, whole in zip(projections, self.unbounded.T, strict=True):
                mask[whole] = True
            self.masks = projections

    def __getitem__(self, index: slice | BoolArray | npt.NDArray[np.integer]) -> PoseRegions:
        """Regions of some of the images: a slice, a boolean mask or an array of positions."""
        part, rows = super().__getitem__(index), np.arange(len(self))[index].tolist()
        chosen = copy(self)
        vars(chosen).update(vars(part))
        chosen.supports, chosen.boxes = ([each[i] for i in rows] for each in (self.supports, self.boxes))
        return chosen

    @classmethod
    def concatenate(cls, parts: Iterable[Regions]) -> PoseRegions:
        """Regions of all the images of `parts`, in order."""
        each = [part for part in parts if isinstance(part, PoseRegions)]
        whole = copy(each[0])
        vars(whole).update(vars(Regions.concatenate(each)))
        whole.supports = [support for part in each for support in part.supports]
        whole.boxes = [boxes for part in each for boxes in part.boxes]
        return whole

    def contains(self, y: npt.ArrayLike, joint: bool = False) -> BoolArray:
        """Whether each projection holds its value of `y`, (n, 7); with `joint`, whether the region holds the pose."""
        if not joint or self.product:
            return super().contains(y, joint)
        held, targets = super().contains(y, joint), np.asarray(y, dtype=np.float64)
        for i in np.flatnonzero(held & ~self.unbounded.all(axis=1)).tolist():
            held[i] = boxes_hold(self.box_edges(i), targets[i])
        return held

    def box_edges(self, i: int) -> FloatArray:
        """The cuboids (b, 7, 2) of image `i` in the targets' units, the one of the most probable hypothesis first."""
        edges = np.empty(self.boxes[i].shape)
        for j, target_edges in enumerate(self.bins.edges_):
            edges[:, j] = target_edges[self.boxes[i][:, j]]
        edges[:, self.unbounded[i]] = (-np.inf, np.inf)
        return edges

    def places(self, i: int) -> list[Place]:
        """The places of image `i`, most probable first, each with the cuboid that holds it.

        What is missing from the sum of their probabilities is that of elsewhere.
        """
        support, places = self.supports[i], []
        for (low, high), edges in zip(np.moveaxis(self.boxes[i], 2, 1), self.box_edges(i), strict=True):
            inside = ((support.cells >= low) & (support.cells < high)).all(axis=1)
            places.append(mean_of(support.mixture, support.rows[inside], edges))
        return sorted(places, key=lambda place: -place.probability)

    @property
    def n_places(self) -> IntArray:
        """(n,) number of cuboids."""
        return np.array([len(boxes) for boxes in self.boxes], dtype=np.int64)

    @property
    def volume(self) -> FloatArray:
        """(n,) sum over the cuboids of the product of their lengths."""
        if self.product:
            return super().volume
        volumes = np.array([np.ptp(self.box_edges(i), axis=2).prod(axis=1).sum() for i in range(len(self))])
        return np.where(self.unbounded.any(axis=1), np.inf, volumes)


def boxes_hold(boxes: FloatArray, point: FloatArray) -> bool:
    """Whether one of b cuboids (b, d, 2) holds a point (d,)."""
    return bool(((boxes[..., 0] <= point) & (point <= boxes[..., 1])).all(axis=1).any())


def _supported(runs: list[IntArray], support: Support, limit: float) -> IntArray:
    """The cuboids (b, 7, 2) that hypotheses support, that of the most probable one first."""
    cells = support.cells[support.levels <= limit]
    if not len(cells) or not all(map(len, runs)):
        return np.empty((0, len(runs), 2), dtype=np.int64)
    # the last run that starts at or before a hypothesis' cell holds it, or none does
    columns = zip(runs, cells.T, strict=True)
    boxes = np.stack([run[np.searchsorted(run[:, 0], at, side="right") - 1] for run, at in columns], axis=1)
    boxes = boxes[((boxes[..., 0] <= cells) & (cells < boxes[..., 1])).all(axis=1)]
    first = {box.tobytes(): i for i, box in reversed(list(enumerate(boxes)))}  # numpy.unique takes most of the time
    return np.asarray(boxes[sorted(first.values())])


def pose_regions(
    rule: SplitConformal, proba: Sequence[RealArray], supports: Sequence[Support], thresholds: RealArray
) -> PoseRegions:
    """Regions of n images at thresholds (n, 7), or (7,), of the rule's score.

    `proba` are seven arrays (n, cells), see :meth:`~conformodal.localizer.localizer.Beliefs.marginals`.
    """
    return supported_regions(rule, rule.regions_at(BinProbabilities(proba), thresholds), supports, thresholds)


def supported_regions(
    rule: SplitConformal, sets: Regions, supports: Sequence[Support], thresholds: RealArray
) -> PoseRegions:
    """The same from the product of the targets' sets."""
    limits = np.broadcast_to(thresholds, sets.unbounded.shape)
    limits = limits.min(axis=1) if _in_shares(rule) else np.full(len(sets), np.inf)
    return PoseRegions(sets, supports, limits, product=rule.joint != "max")


def pose_scores(
    rule: SplitConformal, proba: Sequence[FloatArray], supports: Sequence[Support], targets: FloatArray
) -> RealArray:
    """Nonconformity scores (n, 7) of targets (n, 7), with which :func:`pose_regions` agrees.

    Where all targets are calibrated together, a cuboid around the pose grows with the level until it contains a
    hypothesis that counts: the largest score of a pose is the level that it takes.
    """
    scores = rule.score_samples(BinProbabilities(proba), targets)
    if rule.joint != "max":
        return scores
    columns = [rule.scores_of(p, w) for p, w in zip(proba, rule.bins.widths, strict=True)]
    loc, scale = rule.scales()
    scaled = [(column - a) / b for column, a, b in zip(columns, loc, scale, strict=True)]
    codes, in_shares = rule.bins.encode(targets), _in_shares(rule)
    least = np.full(len(scores), np.inf)
    for i, support in enumerate(supports):
        if (codes[i] < 0).any() or not len(support.levels):
            continue
        levels = support.levels if in_shares else np.full(len(support.levels), -np.inf)
        for column, at, cells in zip(scaled, codes[i], support.cells.T, strict=True):
            levels = np.maximum(levels, _highest_between(column[i], int(at), cells))
        least[i] = levels.min()
    rows, largest = np.arange(len(scores)), np.argmax((scores - loc) / scale, axis=1)
    raised = scores.astype(np.float64)
    raised[rows, largest] = least * scale[largest] + loc[largest]
    return raised


def _highest_between(row: FloatArray, at: int, cells: IntArray) -> FloatArray:
    """(m,) largest entry of a row between one cell and each of m others, both ends included."""
    up, down = np.maximum.accumulate(row[at:]), np.maximum.accumulate(row[at::-1])
    return np.where(cells >= at, up[np.maximum(cells - at, 0)], down[np.maximum(at - cells, 0)])


def _in_shares(rule: SplitConformal) -> bool:
    """Whether thresholds are shares of the belief, as levels of hypotheses are."""
    return rule.joint == "max" and bool(getattr(rule.score_, "normalised", False))


class EvidenceType(IntEnum):
    """What a region is based on; each type has its own thresholds."""

    GLOBAL = 0  # the image as a whole: the model uses no local features
    UNMATCHED = 1  # local features recognised no place
    LANDMARKS = 2  # they recognised a place
    UNKNOWN = 3  # the image is novel, or from beyond the range of known poses: the region is unbounded
    DISTURBED = 4  # the model uses local features; the image is blurred, dark, bright or noisy as no training image is
    WEAK = 5  # they recognised a place, more weakly than in calibration frames


# types whose thresholds are no smaller than the finite ones of others
_AT_LEAST = {
    EvidenceType.DISTURBED: {EvidenceType.UNMATCHED, EvidenceType.LANDMARKS},
    EvidenceType.WEAK: {EvidenceType.DISTURBED},
}


@dataclass(frozen=True, eq=False)
class RegionRules:
    """Calibration scores of n frames, and thresholds from them.

    Each evidence type is calibrated on the calibration frames of that type, so the guarantee holds within each type:
    exactly where frames calibrate; where stretches do, provided that the sources of the folds assign types as those of
    all frames do. A type with too little weight for a finite threshold at alpha has unbounded regions.

    ``DISTURBED`` is calibrated on copies of calibration frames that were disturbed at random, see
    :class:`~conformodal.io.Disturbance`, so its guarantee is about images disturbed likewise.
    Its thresholds are no smaller than the finite ones of ``UNMATCHED`` and ``LANDMARKS``.

    Frames with a p-value of at most `level` are :attr:`EvidenceType.UNKNOWN`, unless a place was recognised: then the
    p-value says how well, and those of at most `level`, in another recording or further away than calibration frames,
    are ``WEAK``. ``LANDMARKS`` is calibrated on all frames in which a place was recognised, so its guarantee includes
    them; as recognition may be as hard as in disturbed images, their thresholds are no smaller than the finite ones of
    ``DISTURBED``.

    Where the world has several rooms, each type is calibrated by room, see
    :func:`~conformodal.localizer.rooms.thresholds_by_group`; disturbed images are calibrated in all rooms together.
    """

    overall: SplitConformal  # calibrated on all frames
    recognised: BoolArray | None  # (n,) whether a place was recognised in each; None without local features
    known_p: FloatArray  # (n,) p-values of the frames, see PlaceNovelty
    level: float  # significance level of the novelty test
    disturbed: SplitConformal | None = None  # on m disturbed frames
    disturbed_p: FloatArray | None = None  # (m,) their p-values; 1 where a place was recognised
    rooms: IntArray | None = None  # (n,) room of each frame by its belief; None where there is one

    @property
    def known(self) -> BoolArray:
        """(n,) whether each frame shows a known place; none whose p-value is 0, from beyond the range of poses."""
        recognised = False if self.recognised is None else self.recognised
        return np.asarray(self.known_p > np.where(recognised, 0.0, self.level))

    @property
    def shows_known_place(self) -> BoolArray:
        """(n,) whether motion treats each frame as of a known place: as :attr:`known`, or recognised out of range."""
        return self.known if self.recognised is None else np.asarray(self.known | self.recognised)

    @cached_property
    def by_type(self) -> dict[EvidenceType, SplitConformal]:
        """Each evidence type but ``UNKNOWN``, calibrated on its own frames, however few."""
        rules = {kind: part_of(self.overall, chosen) for kind, chosen in self._chosen.items()}
        if self.disturbed is not None and self.disturbed_p is not None:
            rules[EvidenceType.DISTURBED] = part_of(self.disturbed, self.disturbed_p > self.level)
        return rules

    @property
    def _chosen(self) -> dict[EvidenceType, BoolArray]:
        """The frames (n,) that calibrate each type, but for disturbed images."""
        if self.recognised is None:
            return {EvidenceType.GLOBAL: self.known}
        return {
            EvidenceType.UNMATCHED: self.known & ~self.recognised,
            EvidenceType.LANDMARKS: self.known & self.recognised,
        }

    @cached_property
    def _by_room(self) -> dict[EvidenceType, dict[int, RealArray]]:
        """Thresholds (7,) of each evidence type and room."""
        if self.rooms is None:
            return {}
        chosen = self._chosen.items()
        return {kind: thresholds_by_group(self.by_type[kind], self.rooms[rows]) for kind, rows in chosen}

    def in_room(self, kind: EvidenceType, room: int) -> SplitConformal:
        """A type calibrated on the frames of one room; on those of all where there is one, or images are disturbed."""
        if self.rooms is None or kind is EvidenceType.DISTURBED:
            return self.by_type[kind]
        return part_of(self.by_type[kind], self.rooms[self._chosen[kind]] == room)

    def kinds(self, known_p: FloatArray, recognised: BoolArray, disturbed: BoolArray | bool = False) -> IntArray:
        """(m,) evidence types of new images, from their p-values, NaN if not tested.

        `recognised` says whether a place was recognised by local features, `disturbed` whether the image's quality is
        out of range.
        """
        novel = known_p <= self.level
        if self.recognised is None:
            return np.where(novel, EvidenceType.UNKNOWN, EvidenceType.GLOBAL).astype(np.int64)
        matched = np.where(novel, EvidenceType.WEAK, EvidenceType.LANDMARKS)
        kinds = np.where(recognised, matched, np.where(novel, EvidenceType.UNKNOWN, EvidenceType.UNMATCHED))
        harder = disturbed & (self.disturbed is not None) & (kinds != EvidenceType.UNKNOWN)
        return np.where(harder, EvidenceType.DISTURBED, kinds).astype(np.int64)

    def thresholds(self, kinds: IntArray, rooms: IntArray | None = None) -> RealArray:
        """(m, 7) thresholds of images with these evidence types, in these `rooms` (m,) of a world that has several.

        Disturbed images have at least the finite thresholds of the types that they would have otherwise: an image may
        as well leave the range of qualities by chance.
        """
        places = [None] * len(kinds) if rooms is None else rooms.tolist()
        limits = [self._threshold(kind, room) for kind, room in zip(kinds.tolist(), places, strict=True)]
        return np.reshape(limits, (-1, self.overall.bins.n_targets))

    def _threshold(self, kind: int, room: int | None) -> RealArray:
        """(7,) thresholds of an evidence type, of all rooms if none is given."""
        if (kind, room) not in self._thresholds:
            calibrated = EvidenceType.LANDMARKS if kind == EvidenceType.WEAK else EvidenceType(kind)
            limit = self._own_threshold(calibrated, room)
            for other in self.by_type.keys() & _AT_LEAST.get(EvidenceType(kind), set()):
                least = self._own_threshold(other, room)
                limit = np.maximum(limit, np.where(np.isfinite(least), least, -np.inf))
            self._thresholds[kind, room] = limit
        return self._thresholds[kind, room]

    @cached_property
    def _thresholds(self) -> dict[tuple[int, int | None], RealArray]:
        """Those that were asked for."""
        return {}

    def _own_threshold(self, kind: EvidenceType, room: int | None) -> RealArray:
        """(7,) thresholds of a type without regard to others."""
        if kind not in self.by_type:
            return np.full(self.overall.bins.n_targets, np.inf)
        every = self.by_type[kind].thresholds_
        return every if room is None else self._by_room.get(kind, {}).get(room, every)

    def at(self, alpha: Alpha) -> RegionRules:
        """The same calibration at another miscoverage rate: regions at a lower rate contain those at a higher one."""
        rate = float(as_alpha(alpha))
        disturbed = None if self.disturbed is None else self.disturbed.at(rate)
        return replace(self, overall=self.overall.at(rate), disturbed=disturbed)


@dataclass(frozen=True, eq=False)
class PlaceNovelty:
    """The novelty test against the frames that the sources learnt from.

    Null hypothesis: the image is exchangeable with left-out frames (or stretches, or recordings) of the training data.
    The p-values are exact if the network was not trained on them; where corners are followed from frame to frame, they
    are those of frames in which they were detected, so approximate.
    """

    test: NoveltyTest  # of the image's appearance: its distance to the most similar known frame
    grid: tuple[int, int]  # rows and columns of the network's map
    # with local features: images in which a place was recognised rank below all others, the more strongly the lower, so
    # that no change of light makes them novel. Calibrated on held-out frames; None without local features
    matched: NoveltyTest | None = None

    @classmethod
    def fit(cls, features: Float32Array, pieces: IntArray, grid: tuple[int, int]) -> Self | None:
        """From features (n, F), and labels (n,) of what is left out together; None for fewer than two labels."""
        if len(np.unique(pieces)) < 2:
            return None
        return cls(NoveltyTest(coarse_features(features, grid).astype(np.float16), pieces), grid)

    @staticmethod
    def ranked(distances: FloatArray, recognition: FloatArray) -> FloatArray:
        """Novelty scores of images whose local features were matched: below 0 where a place was recognised."""
        return np.where(recognition > 0, -recognition, distances)

    def distances(self, evidence: FrameEvidence, left_out: IntArray | None = None) -> FloatArray:
        """(n,) distances of images to the most similar known frame, not counting those of labels `left_out` (n,)."""
        # rounded like the references, so that an image equals itself
        return self.test.scores(evidence.coarse(self.grid).astype(np.float16), left_out)

    def p_values(self, evidence: FrameEvidence, recognition: FloatArray | None = None) -> FloatArray:
        """(n,) p-values of images; a small one indicates an unknown place, or one that is hard to recognise.

        `recognition` (n,) is :attr:`~conformodal.localizer.localizer.Beliefs.recognition`, None for appearance alone.
        """
        if self.matched is None or recognition is None:
            return self.test.p_values(self.distances(evidence))
        distances, rest = np.zeros(len(evidence)), np.flatnonzero(recognition <= 0)
        if rest.size:  # others need no network
            distances[rest] = self.distances(evidence.part(rest))
        return self.matched.p_values(self.ranked(distances, recognition))

    def level(self, asked: float | None) -> float:
        """The significance level: the given one, or the default of :class:`~conformodal.pipeline.config.ModelConfig`.

        The default is at least the smallest possible p-value, since no image is flagged below it.
        """
        if asked is not None:
            return asked
        by_frame = bool((self.test.weights_ == 1).all())
        least = max(test.least_p for test in (self.test, self.matched) if test is not None)
        return max(_LEVEL_FRAMES if by_frame else LEVEL_STRETCHES, least)
