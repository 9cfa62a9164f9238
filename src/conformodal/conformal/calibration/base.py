"""What all calibrators share: scores of true values, and the bins whose score is at most a threshold."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
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
    as_scores,
    as_table,
    as_targets,
    blocks,
    check_block,
)
from conformodal.conformal.errors import ConformalError, NotCalibratedError, WholeRangeWarning
from conformodal.conformal.regions import Regions
from conformodal.conformal.scores import BUILT_IN, Score, cells_of, resolve_score
from conformodal.core.arrays import BoolArray, FloatArray, RealArray

from .joint import Joint, JointRule

Empty = Literal["allow", "mode"]


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
    """

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        joint: Joint = "none",
        empty: Empty = "allow",
    ) -> None:
        as_choice(empty, Empty, "empty")
        as_alpha(alpha)
        if not isinstance(bins, QuantileBins):
            raise ConformalError(f"bins must be QuantileBins, got {type(bins).__name__}")
        self.bins = bins
        self.alpha = alpha
        self.score = resolve_score(score)
        self.cells = bins.refine(cells_of(self.score))
        self.rule = JointRule(joint, bins.n_targets)
        if getattr(self.score, "normalised", False):
            self.rule.keep_scale()
        self.empty: Empty = empty

    @property
    def joint(self) -> Joint:
        """Whether coverage is guaranteed per target, or for all targets together."""
        return self.rule.joint

    @property
    def alpha_per_target(self) -> Fraction:
        """The rate at which each calibrated column is calibrated: alpha, or alpha / d for ``bonferroni``."""
        return self.rule.alpha_per_column(self.alpha)

    def fit_scale(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Scale the targets' scores for ``joint="max"``, on data that is not the calibration data.

        The guarantee holds for any scales; they only balance the targets. Training rows will do with out-of-fold
        `proba`: scores of rows that were learnt from are too low, more so for some targets, which makes sets larger.
        Calibration refuses rows that were given here.
        """
        self.rule.fit_scale(self.score_samples(proba, y), self.alpha)
        return self

    def score_samples(self, proba: Probabilities, y: npt.ArrayLike) -> RealArray:
        """Scores of the true values, (n, d), ``+inf`` outside the edges."""
        parts, _ = as_table(proba, self.bins.sizes)
        values = as_targets(y, n_targets=self.bins.n_targets)
        if values.shape[0] != parts[0].shape[0]:
            raise ConformalError(f"y has {values.shape[0]} rows, proba has {parts[0].shape[0]}")
        codes = self.cells.encode(values)
        scores = np.full(codes.shape, np.inf, dtype=np.result_type(*parts))
        for j, (part, widths) in enumerate(zip(parts, self.bins.widths, strict=True)):
            known = np.flatnonzero(codes[:, j] >= 0)
            at = codes[known, j]
            for rows in blocks(known.size):
                all_bins = self.scores_of(part[known[rows]], widths)
                scores[known[rows], j] = all_bins[np.arange(all_bins.shape[0]), at[rows]]
        return scores

    def regions_at(self, proba: Probabilities, thresholds: RealArray) -> Regions:
        """Regions of all bins whose score is at most a threshold: (d,) for all samples, or (n, d).

        ``+inf`` gives an unbounded set, ``-inf`` the empty set.
        """
        parts, _ = as_table(proba, self.bins.sizes, check=False)
        n, d = parts[0].shape[0], self.bins.n_targets
        limits = as_scores(thresholds, "thresholds")
        if limits.shape not in ((d,), (n, d)):
            raise ConformalError(f"thresholds must have shape ({d},) or ({n}, {d}), got {limits.shape}")
        masks = [self._mask(part, j, limits[..., j]) for j, part in enumerate(parts)]
        unbounded = np.array(np.broadcast_to(np.isposinf(limits), (n, d)))
        if self.empty == "mode":
            self._fill_empty(parts, masks)
        return Regions(self.cells, masks, unbounded)

    def warn_of_whole_range(self, thresholds: RealArray, where: str = "") -> None:
        """Warn if a threshold of (d,) admits a bin of probability 0: sets then hold every bin."""
        for j, (widths, limit) in enumerate(zip(self.bins.widths, thresholds, strict=True)):
            if widths.size == 1 or not np.isfinite(limit):
                continue
            certain = (np.arange(widths.size) == 0)[None].astype(thresholds.dtype)
            worst = float(self.scores_of(certain, widths).max())
            if limit >= worst - widths.size * np.finfo(thresholds.dtype).eps * abs(worst):
                warnings.warn(
                    f"every set of target {j} is the whole range{where}: the threshold admits bins of probability 0, "
                    "as where more than alpha of the calibration rows lie in such bins. Smooth the probabilities, or "
                    "give the classifier to ConformalRegressor, which does",
                    WholeRangeWarning,
                    stacklevel=3,
                )

    def scores_of(self, part: RealArray, widths: FloatArray) -> RealArray:
        """Scores of all cells for rows of one target's probabilities."""
        found = self.score.of_bins(part, widths)
        if type(self.score) in BUILT_IN:
            return found
        cells = (part.shape[0], part.shape[1] * cells_of(self.score))
        if np.shape(found) != cells:
            raise ConformalError(f"score must give scores of shape {cells}, got {np.shape(found)}")
        return as_scores(found)

    def _regions_by_row(self, proba: Probabilities, limits: RealArray, name: str) -> Regions:
        """Regions at thresholds (m, d) of their own, which follow from the argument `name`."""
        parts, whole = as_table(proba, self.bins.sizes, check=False)
        if len(limits) != len(parts[0]):
            raise ConformalError(f"{name} must have one entry per row of proba ({len(parts[0])}), got {len(limits)}")
        return self.regions_at(parts if whole is None else whole, limits)

    def _calibrated(self) -> Any:
        """The calibration scores."""
        if not hasattr(self, "scores_"):
            raise NotCalibratedError(f"{type(self).__name__} is not calibrated yet: call calibrate first")
        return self.scores_

    def _mask(self, part: RealArray, j: int, limit: RealArray) -> BoolArray:
        widths = self.bins.widths[j]
        mask = np.empty((part.shape[0], self.cells.sizes[j]), dtype=bool)
        for rows in blocks(part.shape[0]):
            check_block(part[rows], f"proba of target {j}", rows.start)
            each = limit if limit.ndim == 0 else limit[rows, None]
            np.less_equal(self.scores_of(part[rows], widths), each, out=mask[rows])
        return mask

    def _fill_empty(self, parts: Sequence[RealArray], masks: Sequence[BoolArray]) -> None:
        for part, widths, mask in zip(parts, self.bins.widths, masks, strict=True):
            rows = np.flatnonzero(~mask.any(axis=1))
            if rows.size:
                mask[rows, self.scores_of(part[rows], widths).argmin(axis=1)] = True
