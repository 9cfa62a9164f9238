"""Calibration under covariate shift with known likelihood ratios (Tibshirani, Barber, Candes and Ramdas 2019)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from fractions import Fraction
from itertools import accumulate
from math import ceil
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, as_finite
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import FloatArray, RealArray
from conformodal.core.errors import ConformodalError

from .base import Calibrator


def weighted_ranks(weights: Sequence[float], new_weights: Sequence[float], alpha: Alpha) -> list[int]:
    """Rank of each new sample's threshold among n ranked scores: the first that carries ``1 - alpha``, or n + 1.

    The total weight includes the new sample's own, at a score of ``+inf``.
    """
    # floats are fractions over powers of two: over their common denominator the sums are whole numbers
    exact, new = [Fraction(w) for w in weights], [Fraction(w) for w in new_weights]
    scale = max((w.denominator for w in (*exact, *new)), default=1)
    reached = list(accumulate(int(w * scale) for w in exact))
    totals = [(reached[-1] if reached else 0) + int(w * scale) for w in new]
    share = 1 - as_alpha(alpha)
    return [bisect_left(reached, ceil(total * share)) + 1 if total else len(reached) + 1 for total in totals]


def _as_weights(weights: npt.ArrayLike) -> FloatArray:
    arr = as_finite(weights, "weights", "(n,)")
    if (arr < 0).any():
        raise ConformodalError(f"weights must be at least 0, got {arr.min()} in row {arr.argmin()}")
    return arr


class WeightedConformal(Calibrator):
    """Weighted conformal sets: calibration data from one distribution of inputs, new samples from another.

    If calibration samples are drawn independently from P(x) P(y | x) and the new one from Q(x) P(y | x), coverage is
    guaranteed with weights proportional to dQ/dP at each sample; with estimated ratios it holds approximately.

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`; for an example see
    ``docs/howto/groups-and-shift.md``.
    """

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, weights: npt.ArrayLike) -> Self:
        """Score the calibration samples; `weights` (n,) are likelihood ratios, on any common scale."""
        plain = self.score_samples(proba, y)
        scores = self.calibration_columns(plain).astype(plain.dtype)  # which says how they are rounded
        checked = _as_weights(weights)
        if checked.shape != (scores.shape[0],):
            raise ConformodalError(f"weights must have shape ({scores.shape[0]},), got {checked.shape}")
        self.scores_, self.weights_ = scores, checked
        return self

    def thresholds(self, weights: npt.ArrayLike) -> RealArray:
        """Thresholds of new samples with the given likelihood ratios, (m, d)."""
        scores = np.vstack((self._calibrated(), np.full((1, self.scores_.shape[1]), np.inf, self.scores_.dtype)))
        distinct, which = np.unique(_as_weights(weights), return_inverse=True)
        limits = []
        for column, order in zip(scores.T, np.argsort(scores[:-1], axis=0, kind="stable").T, strict=True):
            ranks = weighted_ranks(self.weights_[order].tolist(), distinct.tolist(), self.alpha_per_target)
            limits.append(column[np.append(order, len(order))][np.array(ranks, dtype=np.int64) - 1][which])
        return self.per_target(np.stack(limits, axis=1))

    def predict(self, proba: Probabilities, weights: npt.ArrayLike) -> Regions:
        """Regions of new samples; `weights` (m,) are their likelihood ratios."""
        return self.regions_at(proba, self.thresholds(weights))
