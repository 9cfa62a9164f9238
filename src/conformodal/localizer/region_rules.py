"""Thresholds of regions by evidence type (Mondrian calibration, Vovk et al. 2003)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from conformodal.conformal import SplitConformal
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

from .settings import NOVELTY


class EvidenceType(IntEnum):
    """What a region is based on; each type has its own thresholds."""

    GLOBAL = 0  # the image as a whole: the model uses no local features
    UNMATCHED = 1  # local features recognised no place
    LANDMARKS = 2  # they recognised a place
    UNKNOWN = 3  # the image is novel, or from beyond the range of known poses: the region is unbounded
    DISTURBED = 4  # the model uses local features; the image is blurred, dark, bright or noisy as no training image is


@dataclass(frozen=True, eq=False)
class RegionRules:
    """Calibration scores of n frames, and thresholds from them.

    Each evidence type is calibrated on the calibration frames of that type, so the guarantee holds within each type:
    exactly where frames calibrate; where stretches do, provided that the sources of the folds assign types as those of
    all frames do. A type with too little weight for a finite threshold at alpha has unbounded regions.

    ``DISTURBED`` is calibrated on copies of calibration frames that were disturbed at random, see
    :class:`~conformodal.io.Disturbance`, so its guarantee is about images disturbed likewise.
    Its thresholds are no smaller than the finite ones of ``UNMATCHED`` and ``LANDMARKS``.

    Frames with a p-value of at most `level` are :attr:`EvidenceType.UNKNOWN`; those in which a place was recognised, of
    at most half of it, see :meth:`is_known`.
    """

    overall: SplitConformal  # calibrated on all frames
    recognised: BoolArray | None  # (n,) whether a place was recognised in each; None without local features
    known_p: FloatArray  # (n,) p-values of the frames, see PlaceNovelty
    level: float  # significance level of the novelty test
    disturbed: SplitConformal | None = None  # on m disturbed frames
    disturbed_p: FloatArray | None = None  # (m,) their p-values

    def is_known(self, p: FloatArray, recognised: BoolArray | bool = False) -> BoolArray:
        """(m,) whether images show a known place, from their p-values and whether a place was recognised in them.

        Recognition counts by itself: a known view from further away than any calibration frame is recognised, weakly.
        """
        return np.asarray(p > np.where(recognised, NOVELTY.share_recognised * self.level, self.level))

    @property
    def known(self) -> BoolArray:
        """(n,) whether each frame shows a known place."""
        return self.is_known(self.known_p, False if self.recognised is None else self.recognised)

    @cached_property
    def by_type(self) -> dict[EvidenceType, SplitConformal]:
        """Each evidence type but ``UNKNOWN``, calibrated on its own frames, however few."""
        if self.recognised is None:
            return {EvidenceType.GLOBAL: part_of(self.overall, self.known)}
        rules = {
            EvidenceType.UNMATCHED: part_of(self.overall, self.known & ~self.recognised),
            EvidenceType.LANDMARKS: part_of(self.overall, self.known & self.recognised),
        }
        if self.disturbed is not None and self.disturbed_p is not None:
            rules[EvidenceType.DISTURBED] = part_of(self.disturbed, self.disturbed_p > self.level)
        return rules

    def kinds(self, known_p: FloatArray, recognised: BoolArray, disturbed: BoolArray | bool = False) -> IntArray:
        """(m,) evidence types of new images, from their p-values, NaN if not tested.

        `recognised` says whether a place was recognised by local features, `disturbed` whether the image's quality is
        out of range.
        """
        kinds = np.full(len(known_p), EvidenceType.GLOBAL)
        if self.recognised is not None:
            kinds = np.where(recognised, EvidenceType.LANDMARKS, EvidenceType.UNMATCHED)
        kinds = np.where(disturbed & (self.disturbed is not None), EvidenceType.DISTURBED, kinds)
        tested_unknown = np.isfinite(known_p) & ~self.is_known(known_p, kinds == EvidenceType.LANDMARKS)
        return np.where(tested_unknown, EvidenceType.UNKNOWN, kinds).astype(np.int64)

    def thresholds(self, kinds: IntArray) -> RealArray:
        """(m, 7) thresholds of images with these evidence types.

        Disturbed images have at least the finite thresholds of the types that they would have otherwise: an image may
        as well leave the range of qualities by chance.
        """
        limits = np.full((len(kinds), self.overall.bins.n_targets), np.inf)
        for kind, rule in self.by_type.items():
            limits[kinds == kind] = rule.thresholds_
        disturbed = kinds == EvidenceType.DISTURBED
        for kind in self.by_type.keys() & {EvidenceType.UNMATCHED, EvidenceType.LANDMARKS}:
            finite = np.where(np.isfinite(self.by_type[kind].thresholds_), self.by_type[kind].thresholds_, -np.inf)
            limits[disturbed] = np.maximum(limits[disturbed], finite)
        return limits

    def at(self, alpha: Alpha) -> RegionRules:
        """The same calibration at another miscoverage rate: regions at a lower rate contain those at a higher one."""
        rate = float(as_alpha(alpha))
        disturbed = None if self.disturbed is None else self.disturbed.at(rate)
        return replace(self, overall=self.overall.at(rate), disturbed=disturbed)


def part_of(rule: SplitConformal, chosen: BoolArray) -> SplitConformal:
    """A rule calibrated on some of its frames (n,) alone."""
    part = SplitConformal(rule.bins, rule.alpha, rule.score, rule.joint, rule.empty)
    if rule.joint == "max":
        loc, scale = rule.scales()
        part.set_scale(scale, loc)
    if rule.units_ is None:
        return part.calibrate_scores(rule.scores_[chosen])
    # a frame keeps its weight in its stretch, so that the guarantees of all types add up to that of a new stretch
    _, group, counts = np.unique(rule.units_, return_inverse=True, return_counts=True)
    return part.calibrate_scores(rule.scores_[chosen], rule.units_[chosen], counts[group][chosen])
