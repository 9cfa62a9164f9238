"""Thresholds of a region by the kind of its evidence (Mondrian calibration, Vovk et al. 2003)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import SplitConformal
from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core import BoolArray

FloatArray = npt.NDArray[np.floating[Any]]


class EvidenceKind(IntEnum):
    """What a region rests on; each kind has thresholds of its own."""

    GLOBAL = 0  # the image as a whole: local features were not matched
    UNMATCHED = 1  # local features were matched, and no place was recognised
    LANDMARKS = 2  # a place was recognised
    UNKNOWN = 3  # the image is novel: the region is the whole space


@dataclass(frozen=True, eq=False)
class RegionRules:
    """Calibration scores of n frames, and thresholds from them.

    Each kind of evidence is calibrated on the calibration frames of that kind. Where frames calibrate, the promise
    holds in each kind, exactly. Where stretches do, it holds in each kind as far as the sources of the folds tell kinds
    as those of all frames do. A kind that too few calibration frames have gets the whole space.

    Attributes
    ----------
    overall
        Calibrated on beliefs without local features, on all frames.
    matched
        Calibrated on beliefs with local features, on all frames; None where no source looks at them.
    recognised
        (n,) whether a place was recognised in each of them.
    known_p
        (n,) p-values of each, see :class:`~conformodal.localization.PlaceNovelty`.
    level
        Images with a p-value of at most this are :attr:`EvidenceKind.UNKNOWN`; so are calibration frames.
    """

    overall: SplitConformal
    matched: SplitConformal | None
    recognised: BoolArray
    known_p: npt.NDArray[np.float64]
    level: float

    @cached_property
    def of(self) -> dict[EvidenceKind, SplitConformal]:
        """The calibrated rule of each kind of evidence but ``UNKNOWN``."""
        known = self.known_p > self.level
        rules = {EvidenceKind.GLOBAL: _part(self.overall, known)}
        if self.matched is not None:
            rules[EvidenceKind.UNMATCHED] = _part(self.matched, known & ~self.recognised)
            rules[EvidenceKind.LANDMARKS] = _part(self.matched, known & self.recognised)
        return rules

    def kinds(
        self, known_p: npt.NDArray[np.float64], looked: BoolArray, recognised: BoolArray
    ) -> npt.NDArray[np.int64]:
        """(m,) kinds of evidence of new images.

        Parameters
        ----------
        known_p
            (m,) their p-values; NaN where images are not tested.
        looked, recognised
            (m,) whether local features were extracted, and whether a place was recognised by them.
        """
        matched = np.where(recognised, EvidenceKind.LANDMARKS, EvidenceKind.UNMATCHED)
        kinds = np.where(looked & (self.matched is not None), matched, EvidenceKind.GLOBAL)
        return np.where(known_p <= self.level, EvidenceKind.UNKNOWN, kinds).astype(np.int64)

    def thresholds(self, kinds: npt.NDArray[np.int64]) -> FloatArray:
        """(m, 7) thresholds of images with these kinds of evidence."""
        limits = np.full((len(kinds), self.overall.bins.n_targets), np.inf)
        for kind, rule in self.of.items():
            limits[kinds == kind] = rule.thresholds_
        return limits

    def at(self, alpha: Alpha) -> RegionRules:
        """The same calibration at another miscoverage rate."""
        rate = float(as_alpha(alpha))
        matched = None if self.matched is None else self.matched.at(rate)
        return replace(self, overall=self.overall.at(rate), matched=matched)


def _part(rule: SplitConformal, chosen: BoolArray) -> SplitConformal:
    part = SplitConformal(rule.bins, rule.alpha, rule.score, rule.joint, rule.empty)
    if rule.joint == "max":
        part.rule.loc_, part.rule.scale_ = rule.rule.loc_, rule.rule.scale_
    if rule.groups_ is None:
        return part.calibrate_scores(rule.scores_[chosen])
    # a frame keeps its weight in its stretch, so that the promises of all kinds add up to that of a new stretch
    _, group, counts = np.unique(rule.groups_, return_inverse=True, return_counts=True)
    return part.calibrate_scores(rule.scores_[chosen], rule.groups_[chosen], counts[group][chosen])
