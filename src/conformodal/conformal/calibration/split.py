"""Split conformal calibration (the paper, section 2; Papadopoulos et al. 2002)."""

from __future__ import annotations

from copy import copy
from fractions import Fraction
from itertools import accumulate
from math import lcm
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, as_array, as_scores
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.grouping import as_groups, factorise
from conformodal.conformal.rank import conformal_quantile, conformal_rank
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import AnyArray, FloatArray, IntArray, RealArray

from .base import Calibrator
from .grouped import grouped_quantile


class SplitConformal(Calibrator):
    """Split conformal prediction sets over bins.

    If the calibration samples and a new sample are exchangeable (drawn together and split at random, say), and neither
    was used to fit the probabilities or the bins, then ``P(y in region) >= 1 - alpha`` per target, or with
    ``joint="bonferroni"`` or ``"max"`` for all targets together.

    With ``groups``, such as parts of a video or whole recordings, only the groups need to be exchangeable, and coverage
    is guaranteed for a random sample of a new group (Dunn, Wasserman and Ramdas 2023; Lee, Barber and Willett 2023).

    Parameters
    ----------
    bins, alpha, score, joint, empty
        As in :class:`~conformodal.conformal.calibration.base.Calibrator`.

    Attributes
    ----------
    scores_ : (n, d) calibration scores of the true bins, ``+inf`` for values outside the edges
    groups_ : (n,) labels of the calibration samples, or None
    group_sizes_ : (n,) size of each sample's whole group, if only one category of its members is here, or None
    batches_ : (n,) labels of batches that thresholds hold for one by one, or None
    thresholds_ : (d,) thresholds, ``+inf`` where n is too small for alpha

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuantileBins, SplitConformal
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 3]])
    >>> proba = np.tile([0.45, 0.1, 0.45], (40, 1))
    >>> y = np.tile([0.5, 2.5], 20)
    >>> SplitConformal(bins, alpha=0.1).calibrate(proba, y).predict(proba[:1]).intervals(0)
    [array([[0., 1.],
           [2., 3.]])]
    """

    scores_: RealArray
    groups_: AnyArray | None
    group_sizes_: IntArray | None
    batches_: IntArray | None
    thresholds_: RealArray

    @property
    def rank(self) -> int:
        """Rank k of the threshold among the exchangeable units; n_units + 1 means an unbounded set."""
        return conformal_rank(self.n_units, self.alpha_per_target)

    @property
    def n_units(self) -> int:
        """Exchangeable units behind the thresholds: calibration samples, or their groups."""
        n = self._calibrated().shape[0]
        return n if self.groups_ is None else len(factorise(self.groups_)[0])

    @property
    def weights(self) -> list[Fraction]:
        """Weight of each calibration sample in exchangeable units: 1, or one over the size of its group."""
        n = len(self._calibrated())
        if self.groups_ is None:
            return [Fraction(1)] * n
        codes = factorise(self.groups_)[1]
        sizes = np.bincount(codes)[codes] if self.group_sizes_ is None else self.group_sizes_
        return [Fraction(1, size) for size in sizes.tolist()]

    @property
    def weight(self) -> Fraction:
        """Sum of :attr:`weights`: thresholds are finite only from ``1 / alpha_per_target - 1`` on."""
        return sum(self.weights, Fraction(0))

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, groups: npt.ArrayLike | None = None) -> Self:
        """Score the calibration samples and set the thresholds.

        Parameters
        ----------
        proba
            (n, d, K), or a list of d arrays (n, K_d).
        y
            (n, d) true values, or (n,) for one target. Values outside the edges score ``+inf``.
        groups
            (n,) labels, see :func:`~conformodal.conformal.grouping.as_groups`; None if samples are exchangeable.
        """
        self.calibrate_scores(self.score_samples(proba, y), groups)
        self.warn_of_whole_range(self.thresholds_)
        return self

    def calibrate_scores(
        self,
        scores: RealArray,
        groups: npt.ArrayLike | None = None,
        group_sizes: IntArray | None = None,
        batches: IntArray | None = None,
    ) -> Self:
        """Set the thresholds from calibration scores (n, d) of :meth:`score_samples`.

        `group_sizes` (n,) are the sizes of the whole groups if only members of one category are given, see
        :func:`~conformodal.conformal.grouped_quantile`. `batches` (n,) label samples of several origins: thresholds are
        no smaller than those of any batch by itself, so that each is covered. A batch that is too small for a finite
        threshold counts with its largest finite score.
        """
        scores = as_scores(scores)
        if scores.ndim != 2 or scores.shape[1] != self.bins.n_targets:
            raise ConformalError(f"scores must have shape (n, {self.bins.n_targets}), got {scores.shape}")
        if groups is not None:
            groups = as_groups(groups, len(scores))
            if group_sizes is not None:
                group_sizes = _as_sizes(group_sizes, factorise(groups)[1])
        elif group_sizes is not None:
            raise ConformalError("group_sizes need groups")
        columns = self.rule.calibration_columns(scores)
        found = self._quantiles(columns, groups, group_sizes)
        for batch in () if batches is None else np.unique(batches):
            its = batches == batch
            units = [None if of is None else of[its] for of in (groups, group_sizes)]
            # that of zeros is infinite only if the batch is too small
            own, enough = (self._quantiles(of, *units) for of in (columns[its], np.zeros_like(columns[its])))
            finite = np.where(np.isfinite(columns[its]), columns[its], -np.inf).max(axis=0)
            found = np.maximum(found, np.where(np.isfinite(enough), own, finite))
        self.scores_, self.groups_, self.group_sizes_, self.batches_ = scores, groups, group_sizes, batches
        self.thresholds_ = self.rule.per_target(found)
        return self

    def _quantiles(self, columns: RealArray, groups: AnyArray | None, group_sizes: IntArray | None) -> RealArray:
        rate = self.alpha_per_target
        if groups is None:
            return conformal_quantile(columns, rate)
        labels, codes = factorise(groups)
        parts = [columns[codes == code] for code in range(len(labels))]
        sizes = None if group_sizes is None else [int(group_sizes[codes == code][0]) for code in range(len(labels))]
        return np.array([grouped_quantile([p[:, j] for p in parts], rate, sizes) for j in range(columns.shape[1])])

    def predict(self, proba: Probabilities) -> Regions:
        """Regions of new samples: every bin whose score is at most the threshold."""
        self._calibrated()
        return self.regions_at(proba, self.thresholds_)

    def at(self, alpha: Alpha) -> SplitConformal:
        """The same calibration at another miscoverage rate."""
        other = copy(self)
        as_alpha(alpha)
        other.alpha = alpha
        other.calibrate_scores(self._calibrated(), self.groups_, self.group_sizes_, self.batches_)
        other.warn_of_whole_range(other.thresholds_)
        return other

    def p_values(self, proba: Probabilities, y: npt.ArrayLike) -> FloatArray:
        """Conformal p-values of values `y`, (n, d), or (n, 1) for ``joint="max"``.

        ``(1 + number of calibration scores at least as large) / (n + 1)``; with groups, ``(1 + sum over groups of the
        share of such scores) / (K + 1)``. With ``empty="allow"`` a value is in its region exactly if its p-value
        exceeds alpha; p-values are not defined where batches are covered one by one.
        """
        calibration = self.rule.columns(self._calibrated())
        if self.batches_ is not None:
            raise ConformalError("p-values need one batch of calibration samples")
        new = self.rule.columns(self.score_samples(proba, y))
        group = np.arange(len(calibration)) if self.groups_ is None else factorise(self.groups_)[1]
        counts = np.bincount(group)
        sizes = counts[group] if self.group_sizes_ is None else self.group_sizes_
        whole = lcm(*sizes.tolist())  # a group's weight, so that every member's is a whole number
        weights = np.array([whole // size for size in sizes.tolist()], dtype=object)
        total = int(weights.sum()) + whole
        found = np.empty(new.shape)
        for j, (scores, column) in enumerate(zip(calibration.T, new.T, strict=True)):
            order = np.argsort(scores, kind="stable")
            below = np.array([0, *accumulate(weights[order])], dtype=object)
            reached = below[np.searchsorted(scores[order], column, side="left")]
            found[:, j] = (total - reached) / total
        return found


def _as_sizes(group_sizes: Any, codes: IntArray) -> IntArray:
    sizes = as_array(group_sizes, "group_sizes")
    if sizes.shape != codes.shape or sizes.dtype.kind not in "iu":
        raise ConformalError(f"group_sizes must be whole numbers, shape {codes.shape}, got {sizes.dtype} {sizes.shape}")
    _, first = np.unique(codes, return_index=True)
    if (sizes != sizes[first][codes]).any():
        row = int(np.argmax(sizes != sizes[first][codes]))
        raise ConformalError(f"group_sizes must be the same within a group; row {row} differs, {sizes[row]}")
    return sizes.astype(np.int64, copy=False)
