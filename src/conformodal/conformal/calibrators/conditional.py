"""Coverage under many conditions at once, which may overlap or be smooth (Gibbs, Cherian and Candes 2025)."""

from __future__ import annotations

import warnings
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Probabilities, as_doubles, as_finite, brief, column_names
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import BoolArray, FloatArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .base import Calibrator

# how far below its upper bound a new sample's dual variable is held: where optima are many, this gives the smallest
_BELOW = 1e-6
# thresholds are raised by this share of the scores' spread: solutions are rounded
_ROUNDING = 1e-9
# shares of the largest singular value, and of a column's mean, below which directions and spreads are rounding errors
_SINGULAR, _CONSTANT = 1e-9, 1e-13
# a scale may be this much above a threshold; scores beyond so many scales count as if they were there
_WIDE, _WIDEST = 1e3, 1e6
# the programme is solved again on scales that much smaller, at most so often; share of a sum that rounding may take
_CLOSER, _PASSES, _LOST = 1e4, 6, 2.0**-46


class ConditionalConformal(Calibrator):
    """Conformal sets with coverage in each of several overlapping groups, or under shifts of smooth conditions.

    The threshold is a constant plus a linear function of the conditions: the quantile regression of the calibration
    scores and of the new sample's, at the largest score that this function reaches. Let calibration samples and a new
    sample be exchangeable, and let f be such a function that is nowhere negative. Then coverage is at least 1 - alpha
    if new samples are drawn with weights f. For a column of zeros and ones, coverage is at least 1 - alpha among the
    samples with a one, as :class:`MondrianConformal` guarantees for groups that do not overlap. If scores given the
    conditions have a continuous distribution, it exceeds 1 - alpha by at most (c + 1) / (n + 1) over the mean of f, for
    c conditions and f of at most 1.

    Each distinct row of conditions takes a linear programme: some 10 ms for a thousand calibration samples.

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`; for an example see
    ``docs/howto/groups-and-shift.md``.
    """

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, conditions: npt.ArrayLike) -> Self:
        """Score the calibration samples; `conditions` (n, c) are numbers, or zeros and ones for groups."""
        plain = self.score_samples(proba, y)
        self.warn_ties(plain)
        scores = self.calibration_columns(plain).astype(plain.dtype)  # which says how they are rounded
        if not len(scores):
            raise ConformodalError("y must hold at least one calibration sample")
        self.names_ = column_names(conditions, "conditions", None)
        self.conditions_ = _as_conditions(conditions, len(scores))
        self.scores_ = scores
        return self

    def thresholds(self, conditions: npt.ArrayLike) -> RealArray:
        """Thresholds of new samples with these conditions (m, c), (m, d)."""
        scores, alpha = self._calibrated(), float(self.alpha_per_target)
        names = column_names(conditions, "conditions", self.names_)
        if names and self.names_ and names != self.names_:
            raise ConformodalError(f"conditions must have the columns {brief(self.names_)}, got {brief(names)}")
        new = _as_conditions(conditions, None, self.conditions_.shape[1])
        distinct, which = np.unique(new, axis=0, return_inverse=True)
        calibration, asked, spanned = _coordinates(self.conditions_, distinct)
        ceilings = self.columns(self._ceilings()[None])[0]
        thresholds = np.full((len(distinct), len(ceilings)), np.inf)
        for j, most in enumerate(ceilings):
            limits = _limits(np.minimum(scores[:, j], most), calibration, asked[spanned], alpha)
            thresholds[spanned, j] = np.where(limits < most, limits, np.inf)
        thresholds = thresholds[which.ravel()]
        if unbounded := int(np.isinf(thresholds).any(axis=1).sum()):
            few = "too few calibration samples have conditions like theirs"
            warnings.warn(f"regions of {unbounded} of {counted(len(new), 'sample')} are unbounded: {few}", stacklevel=3)
        return self.per_target(thresholds)

    def predict(self, proba: Probabilities, conditions: npt.ArrayLike) -> Regions:
        """Regions of new samples with these conditions (m, c)."""
        return self.regions_at(proba, self.thresholds(conditions))

    def _ceilings(self) -> FloatArray:
        """(d,) scores that stand for those of values beyond the bins: above that of a bin of probability 0.

        They do not depend on the calibration samples, so that these and a new sample stay exchangeable.
        """
        ceilings = []
        for widths in self.bins.widths:
            certain, even = np.eye(1, widths.size), np.full((1, widths.size), 1 / widths.size)
            worst = float(self.scores_of(certain, widths).max())
            ceilings.append(worst + ((worst - float(self.scores_of(even, widths).min())) or 1.0))
        return np.array(ceilings)


def _as_conditions(conditions: npt.ArrayLike, n: int | None, n_columns: int | None = None) -> FloatArray:
    """Conditions (n, c) as float64; a vector is one column."""
    given = as_doubles(conditions, "conditions")
    rows = as_finite(given[:, None] if given.ndim == 1 else given, "conditions", "(n, c)")
    if n is not None and len(rows) != n:
        raise ConformodalError(f"conditions must have one row per sample ({n}), got {len(rows)}")
    if n_columns is not None and rows.shape[1] != n_columns:
        raise ConformodalError(f"conditions must have {n_columns} columns as in calibration, got {rows.shape[1]}")
    return rows


def _coordinates(calibration: FloatArray, asked: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Calibration (n, r) and new (m, r) conditions and a constant in an orthonormal basis; which new ones it spans."""
    center, spread = calibration.mean(axis=0), calibration.std(axis=0)
    spread = np.where(spread > _CONSTANT * np.abs(center), spread, 1.0)
    both = [np.column_stack((np.ones(len(rows)), (rows - center) / spread)) for rows in (calibration, asked)]
    _, singular, basis = np.linalg.svd(both[0], full_matrices=False)
    basis = basis[singular > _SINGULAR * singular.max(initial=0)]
    old, new = (rows @ basis.T for rows in both)
    off = np.abs(both[1] - new @ basis).max(axis=1, initial=0)
    return old, new, np.asarray(off <= _SINGULAR * np.maximum(np.abs(both[1]).max(axis=1, initial=0), 1))


def _limits(scores: FloatArray, calibration: FloatArray, asked: FloatArray, alpha: float) -> FloatArray:
    """The largest finite score (m,) of samples with conditions `asked` (m, r) that the quantile regression reaches."""
    from scipy.optimize import linprog  # noqa: PLC0415 - a third of a second to import

    center = float(np.median(scores))
    spread = float(np.quantile(np.abs(scores - center), 0.25)) or float(np.abs(scores - center).max()) or 1.0
    upper, limits = (1 - alpha) / alpha, np.full(len(asked), np.inf)
    exact: Any = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    if np.abs(scores - center).max() > _WIDEST * spread:
        center, spread = 0.0, float(np.abs(scores).max())
    lost, at, rounding = 0, 0.0, 0.0
    for i, row in enumerate(asked):
        function, left, scale = np.zeros(len(row)), scores - center, spread
        # the dual of the quantile regression, in which the new sample's score is larger than the function
        right = -row * (upper - _BELOW)
        for _ in range(_PASSES):
            costs = -np.clip(left / scale, -_WIDEST, _WIDEST)
            solved = linprog(
                costs, A_eq=calibration.T, b_eq=right, bounds=(-1, upper), method="highs-ds", options=exact
            )
            if not solved.success:
                break
            function = function - scale * solved.eqlin.marginals
            at, rounding = center + row @ function, _LOST * (abs(center) + float(np.abs(row) @ np.abs(function)))
            limits[i] = at + max(scale * _ROUNDING, rounding)
            if scale <= max(abs(at) * _WIDE, rounding):
                break
            # what is far from the function stays on its side when it is found more closely
            left, scale = scores - center - calibration @ function, scale / _CLOSER
        hidden = scores[np.abs(scores - at) <= rounding] if np.isfinite(limits[i]) else scores[:0]
        lost += bool(hidden.size and np.ptp(hidden) > _LOST * np.abs(hidden).max())
    if lost:
        told = "so far below others that rounding hides them, and sets are larger: scale them, or calibrate them apart"
        warnings.warn(f"scores at {lost} of {len(asked)} conditions are {told}", stacklevel=4)
    return limits
