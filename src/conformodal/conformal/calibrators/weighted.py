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

from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, as_finite, as_scores
from conformodal.conformal.errors import ConformodalError
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import FloatArray, RealArray

from .base import Calibrator


def weighted_quantile(
    scores: npt.ArrayLike, weights: npt.ArrayLike, new_weights: npt.ArrayLike, alpha: Alpha
) -> RealArray:
    """Threshold for each new sample: the smallest score that carries ``1 - alpha`` of the weight.

    The total weight includes the new sample's own, at a score of ``+inf``. Sums are exact; equal weights give
    :func:`~conformodal.conformal_quantile`.

    Parameters
    ----------
    scores
        (n,) calibration scores.
    weights
        (n,) weights of the calibration samples: at least 0, on any common scale.
    new_weights
        (m,) weights of the new samples, on that scale; so many thresholds are returned.
    alpha
        Miscoverage rate; thresholds are ``+inf`` where no score carries enough.

    Examples
    --------
    >>> from conformodal.conformal import weighted_quantile
    >>> weighted_quantile([0.1, 0.2, 0.3], [1, 1, 2], new_weights=[1, 9], alpha=0.5)
    array([0.3, inf])
    """
    scores, sample_weights = as_scores(scores), _as_weights(weights, "weights")
    new = _as_weights(new_weights, "new_weights")
    if scores.shape != sample_weights.shape:
        raise ConformodalError(
            f"weights must have one entry per score, shape {scores.shape}, got {sample_weights.shape}"
        )
    order = np.argsort(scores, kind="stable")
    ranked = np.append(scores[order], np.inf).astype(scores.dtype)
    distinct, which = np.unique(new, return_inverse=True)
    ranks = weighted_ranks(sample_weights[order].tolist(), distinct.tolist(), alpha)
    return np.asarray(ranked[np.array(ranks, dtype=np.int64) - 1][which])


def weighted_ranks(weights: Sequence[float], new_weights: Sequence[float], alpha: Alpha) -> list[int]:
    """Rank of each new sample's threshold among n ranked scores: the first that carries ``1 - alpha``, or n + 1."""
    # floats are fractions over powers of two: over their common denominator the sums are whole numbers
    exact, new = [Fraction(w) for w in weights], [Fraction(w) for w in new_weights]
    scale = max((w.denominator for w in (*exact, *new)), default=1)
    reached = list(accumulate(int(w * scale) for w in exact))
    totals = [(reached[-1] if reached else 0) + int(w * scale) for w in new]
    share = 1 - as_alpha(alpha)
    return [bisect_left(reached, ceil(total * share)) + 1 if total else len(reached) + 1 for total in totals]


def _as_weights(weights: npt.ArrayLike, name: str) -> FloatArray:
    """Weights as a float64 vector."""
    arr = as_finite(weights, name, "(n,)")
    if (arr < 0).any():
        raise ConformodalError(f"{name} must be at least 0, found {arr.min()} at position {arr.argmin()}")
    return arr


class WeightedConformal(Calibrator):
    """Weighted conformal sets: calibration data from one distribution of inputs, new samples from another.

    If calibration samples are drawn independently from P(x) P(y | x) and the new one from Q(x) P(y | x), coverage is
    guaranteed with weights proportional to dQ/dP at each sample; with estimated ratios it holds approximately.

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuantileBins, WeightedConformal
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 3]])
    >>> y, proba = np.tile([0.5, 2.5], 20), np.tile([0.45, 0.1, 0.45], (40, 1))
    >>> shifted = WeightedConformal(bins, alpha=0.1).calibrate(proba, y, weights=np.linspace(0.5, 1.5, 40))
    >>> shifted.predict(proba[:1], weights=[1.5]).intervals(0)
    [array([[0., 1.],
           [2., 3.]])]
    """

    scores_: RealArray
    weights_: FloatArray

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, weights: npt.ArrayLike) -> Self:
        """Score the calibration samples; `weights` (n,) are likelihood ratios, on any common scale."""
        scores = self._calibration_columns(self.score_samples(proba, y))
        checked = _as_weights(weights, "weights")
        if checked.shape != (scores.shape[0],):
            raise ConformodalError(f"weights must have shape ({scores.shape[0]},), got {checked.shape}")
        self.scores_, self.weights_ = scores, checked
        return self

    def thresholds(self, weights: npt.ArrayLike) -> RealArray:
        """Thresholds of new samples with the given likelihood ratios, (m, d)."""
        scores, alpha = self._calibrated(), self.alpha_per_target
        columns = [weighted_quantile(column, self.weights_, weights, alpha) for column in scores.T]
        return self.per_target(np.stack(columns, axis=1))

    def predict(self, proba: Probabilities, weights: npt.ArrayLike) -> Regions:
        """Regions of new samples; `weights` (m,) are their likelihood ratios."""
        return self._regions_by_row(proba, self.thresholds(weights), "weights")
