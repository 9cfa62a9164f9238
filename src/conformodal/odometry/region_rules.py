"""Thresholds of a region by the kind of evidence that it rests on (Mondrian calibration, Vovk et al. 2003)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import SplitConformal
from conformodal.conformal.checks import Alpha
from conformodal.poses import PoseFix

FloatArray = npt.NDArray[np.floating[Any]]
BoolArray = npt.NDArray[np.bool_]

TRUSTED = 0.9  # a pose by landmarks that is right with this probability is one


class Evidence(IntEnum):
    """Kinds of evidence; regions of each have thresholds of their own."""

    SOFTMAX = 0  # landmarks were not looked for
    UNMATCHED = 1  # landmarks were looked for, and none are trusted
    LANDMARKS = 2  # some are
    UNKNOWN = 3  # the image is like none that is known: the region is the whole space


@dataclass(frozen=True, eq=False)
class RegionRules:
    """Calibration scores of n frames, and thresholds from them.

    Each kind of evidence is calibrated on the calibration frames with that kind of evidence. Where frames calibrate,
    the promise holds in each kind, exactly. Where stretches do, it holds in each kind as far as the sources of the
    folds tell kinds as those of all frames do. A kind that too few calibration frames have gets the whole space.

    Attributes
    ----------
    softmax
        Calibrated on all frames, from the softmax alone.
    pooled
        Calibrated on all frames, from softmax and landmarks, over finer cells; None without landmarks.
    matched
        (n,) whether landmarks were trusted in each of them.
    known_p
        (n,) p-values of each, see :class:`~conformodal.odometry.KnownPlaces`.
    level
        Images with a p-value of at most this are :attr:`Evidence.UNKNOWN`; so are calibration frames.
    """

    softmax: SplitConformal
    pooled: SplitConformal | None
    matched: BoolArray
    known_p: npt.NDArray[np.float64]
    level: float

    @cached_property
    def of(self) -> dict[Evidence, SplitConformal]:
        """The calibrated rule of each kind but the last."""
        known = self.known_p > self.level
        rules = {Evidence.SOFTMAX: _part(self.softmax, known)}
        if self.pooled is not None:
            rules[Evidence.UNMATCHED] = _part(self.pooled, known & ~self.matched)
            rules[Evidence.LANDMARKS] = _part(self.pooled, known & self.matched)
        return rules

    def kinds(
        self, known_p: npt.NDArray[np.float64], fixes: Sequence[Sequence[PoseFix]] | None
    ) -> npt.NDArray[np.int64]:
        """(m,) kinds of evidence of new images, from their p-values (NaN: not tested) and poses by landmarks."""
        if fixes is None or self.pooled is None:
            kinds = np.full(len(known_p), Evidence.SOFTMAX, dtype=np.int64)
        else:
            kinds = np.where(trusted(fixes), Evidence.LANDMARKS, Evidence.UNMATCHED)
        return np.where(known_p <= self.level, Evidence.UNKNOWN, kinds)

    def thresholds(self, kinds: npt.NDArray[np.int64]) -> FloatArray:
        """(m, 7) thresholds of images with these kinds of evidence."""
        limits = np.full((len(kinds), self.softmax.bins.n_targets), np.inf)
        for kind, rule in self.of.items():
            limits[kinds == kind] = rule.thresholds_
        return limits

    def at(self, alpha: Alpha) -> RegionRules:
        """The same calibration at another miscoverage rate."""
        pooled = None if self.pooled is None else self.pooled.at(alpha)
        return replace(self, softmax=self.softmax.at(alpha), pooled=pooled)


def trusted(fixes: Sequence[Sequence[PoseFix]]) -> BoolArray:
    """Whether any of each image's poses by landmarks is trusted."""
    return np.array([bool(trusted_only(its)) for its in fixes], dtype=bool)


def trusted_only(fixes: Sequence[PoseFix]) -> list[PoseFix]:
    """Those of an image's poses by landmarks that are trusted."""
    return [fix for fix in fixes if fix.trust >= TRUSTED]


def _part(rule: SplitConformal, chosen: BoolArray) -> SplitConformal:
    part = SplitConformal(rule.bins, rule.alpha, rule.score, rule.joint, rule.empty)
    if rule.joint == "max":
        part.rule.loc_, part.rule.scale_ = rule.rule.loc_, rule.rule.scale_
    if rule.groups_ is None:
        return part.calibrate_scores(rule.scores_[chosen])
    # a frame keeps its weight in its stretch, so that the promises of all kinds add up to that of a new stretch
    _, group, counts = np.unique(rule.groups_, return_inverse=True, return_counts=True)
    return part.calibrate_scores(rule.scores_[chosen], rule.groups_[chosen], counts[group][chosen])
