"""Coverage under many conditions at once, which may overlap or be smooth (Gibbs, Cherian and Candes 2025)."""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Probabilities, as_array, as_finite, as_table, column_names
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import FloatArray, RealArray

from .base import Calibrator

# how far below its upper bound a new sample's dual variable is held: where optima are many, this gives the smallest
_BELOW = 1e-6
# In standard deviations of the scores: thresholds are raised by this much, because solutions are rounded, and infinite
# scores are this far beyond all others
_ROUNDING, _BEYOND = 1e-9, 10.0


class ConditionalConformal(Calibrator):
    """Conformal sets with coverage in each of several overlapping groups, or under shifts of smooth conditions.

    The threshold is a linear function of the conditions: the quantile regression of the calibration scores and of the
    new sample's, at the largest score that this function reaches. Let calibration samples and a new sample be
    exchangeable, and let f be a linear function of the conditions, or a constant, that is nowhere negative. Then
    coverage is at least 1 - alpha if new samples are drawn with weights f. For a column of zeros and ones, coverage
    is at least 1 - alpha among the samples with a one, as :class:`MondrianConformal` guarantees for groups that do
    not overlap. With c conditions it exceeds 1 - alpha by at most (c + 1) / (n + 1) over the mean of f, for f of at
    most 1 and scores without ties.

    Each distinct row of conditions takes one linear programme, some milliseconds for a thousand calibration samples.

    Parameters
    ----------
    bins, alpha, score, joint, empty
        As in :class:`~conformodal.conformal.calibration.base.Calibrator`.

    Attributes
    ----------
    scores_ : (n, columns) calibration scores
    conditions_ : (n, c)

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import ConditionalConformal, QuantileBins
    >>> rng = np.random.default_rng(0)
    >>> old, ill = rng.random(2000) < 0.5, rng.random(2000) < 0.5  # two groups that overlap
    >>> y = rng.normal(0, 1 + old + ill)
    >>> bins = QuantileBins(50).fit(y[:1000])
    >>> proba, groups = np.full((2000, 50), 1 / 50), np.column_stack((old, ill))
    >>> by_group = ConditionalConformal(bins, score="density").calibrate(proba[:1000], y[:1000], groups[:1000])
    >>> held = by_group.predict(proba[1000:], groups[1000:]).contains(y[1000:])[:, 0]
    >>> [round(float(held[which[1000:]].mean()), 2) for which in (old, ill, ~old & ~ill)]
    [0.92, 0.93, 0.92]
    """

    scores_: RealArray
    conditions_: FloatArray
    names_: list[str]

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, conditions: npt.ArrayLike) -> Self:
        """Score the calibration samples; `conditions` (n, c) are numbers, or zeros and ones for groups."""
        scores = self.rule.calibration_columns(self.score_samples(proba, y))
        self.names_ = column_names(conditions, "conditions", None)
        self.conditions_ = _as_conditions(conditions, len(scores))
        self.scores_ = scores
        return self

    def thresholds(self, conditions: npt.ArrayLike) -> RealArray:
        """Thresholds of new samples with these conditions (m, c), (m, d)."""
        scores, alpha = self._calibrated(), float(self.alpha_per_target)
        column_names(conditions, "conditions", self.names_)
        new = _as_conditions(conditions, None, self.conditions_.shape[1])
        distinct, which = np.unique(new, axis=0, return_inverse=True)
        # equal programmes in better numbers
        scale = np.maximum(np.abs(self.conditions_).max(axis=0, initial=0), np.abs(distinct).max(axis=0, initial=0))
        known, asked = (_with_ones(rows / np.where(scale > 0, scale, 1)) for rows in (self.conditions_, distinct))
        columns = [_limits(column.astype(np.float64), known, asked, alpha) for column in scores.T]
        return self.rule.per_target(np.stack(columns, axis=1)[which.ravel()])

    def predict(self, proba: Probabilities, conditions: npt.ArrayLike) -> Regions:
        """Regions of new samples with these conditions (m, c)."""
        parts, whole = as_table(proba, self.bins.sizes, check=False)
        limits = self.thresholds(conditions)
        if len(limits) != len(parts[0]):
            raise ConformalError(f"conditions must have one row per row of proba ({len(parts[0])}), got {len(limits)}")
        return self.regions_at(parts if whole is None else whole, limits)


def _as_conditions(conditions: npt.ArrayLike, n: int | None, n_columns: int | None = None) -> FloatArray:
    """Conditions (n, c) as float64; a vector is one column."""
    given = as_array(conditions, "conditions")
    found = as_finite(given[:, None] if given.ndim == 1 else given, "conditions", "(n, c)")
    if n is not None and len(found) != n:
        raise ConformalError(f"conditions must have one row per sample ({n}), got {len(found)}")
    if n_columns is not None and found.shape[1] != n_columns:
        raise ConformalError(f"conditions must have {n_columns} columns as in calibration, got {found.shape[1]}")
    return found


def _with_ones(rows: FloatArray) -> FloatArray:
    return np.column_stack((np.ones(len(rows)), rows))


def _limits(scores: FloatArray, known: FloatArray, asked: FloatArray, alpha: float) -> FloatArray:
    """The largest score (m,) of samples with conditions `asked` (m, c) that the quantile regression reaches."""
    from scipy.optimize import linprog  # noqa: PLC0415 - a third of a second to import

    finite = scores[np.isfinite(scores)]
    if not finite.size:
        return np.full(len(asked), np.inf)
    center, spread = float(finite.mean()), float(finite.std()) or 1.0
    # infinite scores are as good as any beyond all others
    below, above = (finite.min() - center) / spread - _BEYOND, (finite.max() - center) / spread + _BEYOND
    own = np.clip((scores - center) / spread, below, above)
    upper = (1 - alpha) / alpha
    found = np.empty(len(asked))
    for i, row in enumerate(asked):
        # the dual of the quantile regression, in which the new sample's score is larger than the function
        solved = linprog(-own, A_eq=known.T, b_eq=-row * (upper - _BELOW), bounds=(-1, upper), method="highs-ds")
        found[i] = -row @ solved.eqlin.marginals if solved.success else np.inf
    return np.where(found >= above - _ROUNDING, np.inf, center + spread * (found + _ROUNDING))
