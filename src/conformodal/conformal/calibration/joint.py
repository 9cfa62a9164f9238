"""Coverage of several targets, each alone or all together."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Literal, cast

import numpy as np

from conformodal.conformal.checks import Alpha, as_alpha, as_choice
from conformodal.conformal.errors import ConformalError, NotCalibratedError
from conformodal.conformal.rank import conformal_quantile
from conformodal.conformal.scores import row_uniforms
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

Joint = Literal["none", "bonferroni", "max"]
# calibration rows of which the scales may have seen no more; rows of discrete scores may look alike by chance
_MOST_SEEN = 0.8


def as_joint(joint: str) -> Joint:
    """Check the name of a kind of joint coverage."""
    as_choice(joint, Joint, "joint")
    return cast(Joint, joint)


class JointRule:
    """Maps scores of d targets to the calibrated columns, and their thresholds back to the targets.

    ``none`` and ``bonferroni`` calibrate d columns; ``max`` calibrates one, the largest of the targets' scores after
    the shift and scale of :meth:`fit_scale`.
    """

    loc_: FloatArray
    scale_: FloatArray
    seen_: FloatArray

    def __init__(self, joint: Joint, n_targets: int) -> None:
        self.joint = as_joint(joint)
        self.n_targets = n_targets

    def alpha_per_column(self, alpha: Alpha) -> Fraction:
        """The exact rate at which every column is calibrated."""
        rate = as_alpha(alpha)
        return rate / self.n_targets if self.joint == "bonferroni" else rate

    def fit_scale(self, scores: RealArray, alpha: Alpha) -> None:
        """Take shift and scale of every target's scores (n, d) from data that is not the calibration data.

        The shift is the median; the scale is the distance from there to the rank of alpha / d, so that targets with
        equal upper tails contribute equally.
        """
        half, tail = Fraction(1, 2), as_alpha(alpha) / self.n_targets
        self.seen_ = _single(scores)
        self.loc_, self.scale_ = np.zeros(self.n_targets), np.ones(self.n_targets)
        for j in range(self.n_targets):
            finite = scores[np.isfinite(scores[:, j]), j].astype(np.float64)
            if finite.size == 0:
                raise ConformalError(f"no training value of target {j} lies within its bins: nothing to scale by")
            self.loc_[j] = np.minimum(conformal_quantile(finite, half), finite.max())
            reach = float(np.minimum(conformal_quantile(finite, tail), finite.max()) - self.loc_[j])
            self.scale_[j] = reach if reach > 0 else float(finite.std()) or 1.0

    def keep_scale(self) -> None:
        """Leave the scores of all targets unscaled, because they are comparable."""
        self.loc_, self.scale_ = np.zeros(self.n_targets), np.ones(self.n_targets)

    def calibration_columns(self, scores: RealArray) -> RealArray:
        """:meth:`columns` of calibration scores; rows that :meth:`fit_scale` saw would break the guarantee."""
        if self.joint == "max" and self.n_targets > 1 and len(scores) and hasattr(self, "seen_"):
            shared = int(np.isin(_single(scores), self.seen_).sum())
            if shared > _MOST_SEEN * len(scores):
                raise ConformalError(
                    f"fit_scale saw {shared} of the {len(scores)} calibration rows, with which coverage falls below "
                    "1 - alpha: give it other rows, such as training rows scored out of fold"
                )
        return self.columns(scores)

    def columns(self, scores: RealArray) -> RealArray:
        """The calibrated columns of scores (n, d): (n, d), or (n, 1) for ``max``."""
        if self.joint != "max":
            return scores
        self._scaled()
        with np.errstate(over="ignore"):
            return np.asarray(((scores - self.loc_) / self.scale_).max(axis=1, keepdims=True))

    def per_target(self, thresholds: RealArray) -> RealArray:
        """Thresholds of the targets' own scores, (..., d), from those of the columns.

        For ``max`` each is the largest float whose scaled value is at most the threshold, so that membership and score
        agree to the last bit.
        """
        if self.joint != "max":
            return thresholds
        self._scaled()
        limit = np.broadcast_to(thresholds, (*thresholds.shape[:-1], self.n_targets)).astype(np.float64)
        raw = highest_float(lambda x: (x - self.loc_) / self.scale_ <= limit, limit.shape)
        return np.where(np.isposinf(limit), np.inf, raw)

    def _scaled(self) -> None:
        if not hasattr(self, "loc_"):
            raise NotCalibratedError('joint="max" needs scales: call fit_scale(proba_train, y_train) first')


def _single(scores: RealArray) -> FloatArray:
    """One number per row of scores (n, d), for the rows that occur once."""
    found, counts = np.unique(row_uniforms(scores), return_counts=True)
    return np.asarray(found[counts == 1])


def highest_float(holds: Callable[[FloatArray], BoolArray], shape: tuple[int, ...]) -> FloatArray:
    """Largest finite float for which `holds`, entry by entry, or ``-inf``; `holds` must not turn true as it grows.

    Found by bisection over the floats, in the order of their integer representation.
    """
    top = int(np.array(np.finfo(np.float64).max).view(np.int64))
    # places -top - 1 (nothing holds) to top; 0 stands for both zeros
    low, high = np.full(shape, -top - 1, dtype=np.int64), np.full(shape, top, dtype=np.int64)

    def number(place: IntArray) -> FloatArray:
        return np.copysign(np.abs(place).view(np.float64), place)

    while (low < high).any():
        middle = (low >> 1) + (high >> 1) + ((low | high) & 1)  # rounded up, without overflow
        with np.errstate(over="ignore"):
            ok = holds(number(middle))
        low, high = np.where(ok, middle, low), np.where(ok, high, np.maximum(middle - 1, low))
    return np.where(low < -top, -np.inf, number(low))
