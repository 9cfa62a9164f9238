"""What all calibrators share: scores of true values, joint coverage of several targets, and regions at thresholds."""

from __future__ import annotations

import warnings
from copy import copy
from fractions import Fraction
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.checks import (
    Alpha,
    Probabilities,
    as_alpha,
    as_choice,
    as_probabilities,
    as_scores,
    as_targets,
    blocks,
    not_calibrated,
)
from conformodal.conformal.rank import conformal_quantile, conformal_rank
from conformodal.conformal.regions import Regions
from conformodal.conformal.scores import BUILT_IN, Aps, Lac, Score, resolve_score, row_uniforms
from conformodal.core.arrays import FloatArray, RealArray
from conformodal.core.errors import ConformodalError

Empty = Literal["allow", "mode"]
Joint = Literal["none", "bonferroni", "max"]
# shares of a score by which it may be rounded, by the bytes of its floating type: some units of the last place
_ROUNDING = {4: 2.0**-20, 8: 2.0**-40}
# share of the calibration rows that the scales may have seen: rows of discrete scores may look alike by chance
_MAX_SHARED = 0.8


class Calibrator:
    """Bins, a score, a miscoverage rate and its joint form; subclasses find the thresholds.

    Parameters
    ----------
    bins
        Fitted bins.
    alpha
        Miscoverage rate in (0, 1).
    score
        A name from :data:`~conformodal.conformal.scores.SCORES` (``"lac"`` is the paper's), or a
        :class:`~conformodal.conformal.scores.Score`.
    joint
        ``"none"``: coverage is guaranteed per target (the paper's). Otherwise it is guaranteed for all targets
        together: ``"bonferroni"`` calibrates every target at alpha / d; ``"max"`` sets one threshold over the largest
        of the targets' scores, scaled by :meth:`fit_scale` unless they are comparable (``hpd``, ``aps``).
    empty
        How empty sets are handled. ``"allow"``: they stay; sets are exactly the values whose score is at most the
        threshold. ``"mode"``: the best bin is added; coverage can only rise.

    Attributes
    ----------
    scores_ : (n, d) calibration scores
    loc_, scale_ : (d,) shift and scale of the targets' scores for ``joint="max"``
    """

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        joint: Joint = "none",
        empty: Empty = "allow",
    ) -> None:
        self.bins = bins
        self.alpha = alpha
        self.score = score
        self.joint = joint
        self.empty = empty

    def check_parameters(self) -> None:
        """Refuse parameters that are not valid; called before scores are taken."""
        if not isinstance(self.bins, QuantileBins):
            raise ConformodalError(f"bins must be QuantileBins, got {type(self.bins).__name__}")
        as_alpha(self.alpha)
        resolve_score(self.score)
        as_choice(self.joint, Joint, "joint")
        as_choice(self.empty, Empty, "empty")

    @property
    def score_(self) -> Score:
        """The score as an object."""
        return resolve_score(self.score)

    @property
    def alpha_per_target(self) -> Fraction:
        """The rate at which each calibrated column is calibrated: alpha, or alpha / d for ``bonferroni``."""
        rate = as_alpha(self.alpha)
        return rate / self.bins.n_targets if self.joint == "bonferroni" else rate

    def at(self, alpha: Alpha) -> Self:
        """The same calibration at another miscoverage rate."""
        self._calibrated()
        other = copy(self)
        other.alpha = alpha
        other._set_thresholds()
        return other

    def fit_scale(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Scale the targets' scores for ``joint="max"``, on data that is not the calibration data.

        The shift is the median; the scale is the distance from there to the rank of alpha / d, so that targets with
        equal upper tails contribute equally. The guarantee holds for any scales; they only balance the targets.
        Training rows will do with out-of-fold `proba`: scores of rows that were learnt from are too low, more so for
        some targets, which makes sets larger. Calibration refuses rows that were given here.
        """
        scores, d = self.score_samples(proba, y), self.bins.n_targets
        loc, scale, tail = np.zeros(d), np.ones(d), as_alpha(self.alpha) / d
        for j, column in enumerate(scores.T):
            finite = column[np.isfinite(column)].astype(np.float64)
            if finite.size == 0:
                raise ConformodalError(f"no training value of target {j} lies within its bins: nothing to scale by")
            loc[j] = np.minimum(conformal_quantile(finite, Fraction(1, 2)), finite.max())
            reach = float(np.minimum(conformal_quantile(finite, tail), finite.max()) - loc[j])
            scale[j] = reach if reach > 0 else float(finite.std()) or 1.0
        self._scale_rows = _unique_rows(scores)
        return self.set_scale(scale, loc)

    def set_scale(self, scale: npt.ArrayLike = 1.0, loc: npt.ArrayLike = 0.0) -> Self:
        """Set scale and shift of the targets' scores, (d,) or one for all; by default scores stay as they are."""
        d = self.bins.n_targets
        self.loc_, self.scale_ = (np.broadcast_to(np.asarray(v, np.float64), (d,)).copy() for v in (loc, scale))
        return self

    def score_samples(self, proba: Probabilities, y: npt.ArrayLike) -> RealArray:
        """Scores of the true values, (n, d), ``+inf`` outside the edges."""
        self.check_parameters()
        parts = as_probabilities(proba, self.bins.sizes)
        values = as_targets(y, n_targets=self.bins.n_targets)
        if values.shape[0] != parts[0].shape[0]:
            raise ConformodalError(f"y has {values.shape[0]} rows, proba has {parts[0].shape[0]}")
        codes = self.bins.encode(values)
        scores = np.full(codes.shape, np.inf, dtype=np.result_type(*parts))
        for j, (part, widths) in enumerate(zip(parts, self.bins.widths, strict=True)):
            within = np.flatnonzero(codes[:, j] >= 0)
            for block in blocks(within.size):
                rows = within[block]
                scores[rows, j] = self.scores_of(part[rows], widths)[np.arange(rows.size), codes[rows, j]]
        return scores

    def regions_at(self, proba: Probabilities, thresholds: RealArray) -> Regions:
        """Regions of all bins whose score is at most a threshold: (d,) for all samples, or (n, d).

        ``+inf`` gives an unbounded set, ``-inf`` the empty set.
        """
        parts = as_probabilities(proba, self.bins.sizes)
        limits, (n, d) = as_scores(thresholds, "thresholds"), (len(parts[0]), self.bins.n_targets)
        if limits.shape not in ((d,), (n, d)):
            raise ConformodalError(f"there must be thresholds for {n} rows of {d} targets, got shape {limits.shape}")
        unbounded = np.array(np.broadcast_to(np.isposinf(limits), (n, d)))
        double = parts[0].dtype == np.float64  # sums in single precision depend on where they start
        if n == 1 and double and type(self.score_) is Aps and self.empty != "mode":  # as for each frame of a stream
            starts = np.concatenate(([0], np.cumsum(self.bins.sizes)[:-1]))
            row, widths = np.concatenate(parts, axis=1)[0], np.concatenate(self.bins.widths)
            mask = self.score_.level_set(row, widths, limits.reshape(d), starts)
            return Regions(self.bins, np.split(mask[None], starts[1:], axis=1), unbounded)
        masks = []
        for part, limit, widths in zip(parts, limits.T[..., None], self.bins.widths, strict=True):
            mask = np.empty(part.shape, dtype=bool)
            for rows in blocks(n):
                scores = self.scores_of(part[rows], widths)
                np.less_equal(scores, limit if limits.ndim == 1 else limit[rows], out=mask[rows])
                if self.empty == "mode":
                    mask[rows][np.arange(len(scores)), scores.argmin(axis=1)] |= ~mask[rows].any(axis=1)
            masks.append(mask)
        return Regions(self.bins, masks, unbounded)

    def scores_of(self, part: RealArray, widths: FloatArray) -> RealArray:
        """Scores of all bins for rows (n, K) of one target's probabilities."""
        scores = self.score_.of_bins(part, widths)
        if isinstance(self.score_, BUILT_IN):
            return scores
        if np.shape(scores) != part.shape:
            raise ConformodalError(f"score must give scores of shape {part.shape}, got {np.shape(scores)}")
        return as_scores(scores)

    def columns(self, scores: RealArray) -> RealArray:
        """The calibrated columns of scores (n, d): (n, d), or (n, 1) for ``joint="max"``."""
        if self.joint != "max":
            return scores
        loc, scale = self.scales()
        with np.errstate(over="ignore"):
            return np.asarray(((scores - loc) / scale).max(axis=1, keepdims=True))

    def calibration_columns(self, scores: RealArray) -> RealArray:
        """:meth:`columns` of calibration scores; rows that :meth:`fit_scale` saw would break the guarantee."""
        if self.joint == "max" and self.bins.n_targets > 1 and len(scores) and hasattr(self, "_scale_rows"):
            shared = int(np.isin(_unique_rows(scores), self._scale_rows).sum())
            if shared > _MAX_SHARED * len(scores):
                raise ConformodalError(
                    f"fit_scale saw {shared} of the {len(scores)} calibration rows, with which coverage falls below "
                    "1 - alpha: give it other rows, such as training rows scored out of fold"
                )
        return self.columns(scores)

    def per_target(self, thresholds: RealArray) -> RealArray:
        """Thresholds of the targets' own scores, (..., d), from those of the columns.

        They are raised by what scores may be rounded, so that no score at the threshold is lost.
        """
        loc, scale = self.scales()
        scaled = np.asarray(scale * thresholds, dtype=np.float64)
        rounding = self.rounding(np.maximum(np.abs(loc), np.abs(scaled)), self._calibrated().dtype)
        return np.where(np.isfinite(scaled), np.minimum(loc + scaled + rounding, np.finfo(np.float64).max), scaled)

    def rounding(self, sizes: FloatArray, dtype: np.dtype[Any]) -> FloatArray:
        """By how much scores of such sizes may differ for equal samples: products of matrices round by their shape."""
        # scores that are shares are differences or sums of numbers of up to 1; others round by their own size
        sizes = np.maximum(sizes, 1) if isinstance(self.score_, (Lac, Aps)) else sizes
        return np.asarray(_ROUNDING[dtype.itemsize] * sizes + np.finfo(dtype).smallest_subnormal)

    def scales(self) -> tuple[FloatArray, FloatArray]:
        """Shift and scale (d,) of the targets' scores, which ``joint="max"`` compares."""
        if self.joint == "max" and hasattr(self, "loc_"):
            return self.loc_, self.scale_
        if self.joint != "max" or getattr(self.score_, "normalised", False):
            return np.zeros(self.bins.n_targets), np.ones(self.bins.n_targets)
        raise not_calibrated('joint="max" needs scales: call fit_scale(proba_train, y_train) first')

    def warn_ties(self, scores: RealArray) -> None:
        """Warn where more than alpha of calibration scores (n, d) are the worst there is: sets are whole ranges."""
        for j, (column, widths) in enumerate(zip(scores.T, self.bins.widths, strict=True)):
            known = widths.size > 1 and isinstance(self.score_, BUILT_IN)
            if not known or conformal_rank(column.size, self.alpha_per_target) > column.size:
                continue
            certain = np.eye(widths.size, dtype=scores.dtype)[[0, -1]]  # in two bins: all others are impossible
            worst = float(self.scores_of(certain, widths).max())
            rounding = float(self.rounding(np.array(abs(worst)), scores.dtype))
            tied = int(((column >= worst - rounding) & np.isfinite(column)).sum())
            if tied > self.alpha_per_target * column.size:
                name = (
                    f" of {self.bins.names[j]}" if self.bins.names else f" of target {j}" if scores.shape[1] > 1 else ""
                )
                warnings.warn(
                    f"sets{name} are whole ranges: {tied} of {column.size} calibration values have probability zero, "
                    "or as good as zero. The distributions are too narrow: widen them, or smooth them",
                    stacklevel=3,
                )

    def _set_thresholds(self) -> None:
        """Thresholds that follow from the calibration scores and alpha alone, if there are any."""

    def _calibrated(self) -> Any:
        """The calibration scores."""
        if not hasattr(self, "scores_"):
            raise not_calibrated(f"{type(self).__name__} is not calibrated yet: call calibrate first")
        return self.scores_


def _unique_rows(scores: RealArray) -> FloatArray:
    """One number per row of scores (n, d), for the rows that occur once."""
    numbers, counts = np.unique(row_uniforms(scores), return_counts=True)
    return np.asarray(numbers[counts == 1])
