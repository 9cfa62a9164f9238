"""How far fixes are off, and how often altogether wrong, learnt from frames whose truth was hidden from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from sklearn.linear_model import LogisticRegression

from conformodal.poses import PoseFix
from conformodal.reasoning import fit_growth

FloatArray = npt.NDArray[np.float64]

_LEAST_FIXES = 20
# Median and 95th percentile of the length of a standard normal vector in three dimensions: whichever asks for more.
_MEDIAN_OF_NORM3, _TAIL_OF_NORM3 = 1.5382, 2.7955
_WRONG = 5.0  # a fix off by more spreads than that is altogether wrong
_SAME_WAY_RAD = 1.0  # a fix turned by more is another pose, however near: its error is no error of measurement
_LEAST_APART = 0.005  # nearer than that, in depths and radians, all frames are equally near


@dataclass(frozen=True)
class FixScale:
    """How errors of fixes depend on their claims, and on how far the nearest known frame is.

    Attributes
    ----------
    position, position_growth, position_apart
        Spread in metres: the first, times the claim to the power of the second, times the distance from the nearest
        known frame to the power of the third.
    rotation, rotation_growth, rotation_apart
        The same in radians.
    trust_offset, trust_slopes
        Log odds that a fix is right: the first, plus the others times the logarithms of what speaks for it.
    """

    position: float
    position_growth: float
    position_apart: float
    rotation: float
    rotation_growth: float
    rotation_apart: float
    trust_offset: float
    trust_slopes: tuple[float, ...]

    def apply(self, fix: PoseFix, *evidence: float) -> PoseFix:
        """The fix with spreads of the size of its errors; its own are its claims."""
        odds = self.trust_offset + float(np.dot(self.trust_slopes, np.log(evidence)))
        apart = max(fix.apart, _LEAST_APART)
        return replace(
            fix,
            sigma_m=self.position * fix.sigma_m**self.position_growth * apart**self.position_apart,
            sigma_rad=self.rotation * fix.sigma_rad**self.rotation_growth * apart**self.rotation_apart,
            trust=float(1 / (1 + np.exp(-odds))),
        )


@dataclass(frozen=True, eq=False)
class FixErrors:
    """Errors of m fixes, in metres and radians, beside what they claimed and what spoke for them.

    Attributes
    ----------
    off_m, claim_m, off_rad, claim_rad
        (m,) errors and claims.
    apart
        (m,) distances from the nearest known frame; 0 where they are not known.
    evidence
        (m, e) what spoke for each fix, positive.
    weights
        (m,) how much each counts for the probability of being right.
    """

    off_m: FloatArray
    claim_m: FloatArray
    off_rad: FloatArray
    claim_rad: FloatArray
    apart: FloatArray
    evidence: FloatArray
    weights: FloatArray


def fit_fix_scale(errors: FixErrors, same_place_m: float) -> FixScale | None:
    """Learn the scale; None from fewer than twenty fixes.

    Parameters
    ----------
    errors
        Of fixes that did not know the truth.
    same_place_m
        A fix further off is at another place: its error is the distance between the two.
    """
    here = (errors.off_m < same_place_m) & (errors.off_rad < _SAME_WAY_RAD)
    if here.sum() < _LEAST_FIXES:
        return None
    apart = np.maximum(errors.apart, _LEAST_APART)
    position = _scale(errors.off_m[here], errors.claim_m[here], apart[here])
    rotation = _scale(errors.off_rad[here], errors.claim_rad[here], apart[here])
    claimed = position[0] * errors.claim_m ** position[1] * apart ** position[2]
    right = here & (errors.off_m < _WRONG * claimed)
    return FixScale(*position, *rotation, *_trust(np.log(errors.evidence), right, errors.weights))


def _scale(errors: FloatArray, claims: FloatArray, apart: FloatArray) -> tuple[float, float, float]:
    """Factor and the two powers; the distance first, which says more."""
    by_distance = fit_growth(errors, apart)
    left = errors / apart**by_distance
    growth = fit_growth(left, claims)
    left = left / claims**growth
    return (
        max(float(np.median(left)) / _MEDIAN_OF_NORM3, float(np.quantile(left, 0.95)) / _TAIL_OF_NORM3, 1e-6),
        growth,
        by_distance,
    )


def _trust(
    log_evidence: FloatArray, right: npt.NDArray[np.bool_], weights: FloatArray
) -> tuple[float, tuple[float, ...]]:
    """Offset and slopes of the log odds of being right; one more of each kind, so that neither is certain."""
    middle = np.median(log_evidence, axis=0)
    x = np.concatenate((log_evidence, [middle, middle]))
    right, weights = np.concatenate((right, [True, False])), np.concatenate((weights, [1.0, 1.0]))
    kept = list(range(x.shape[1]))
    while kept:
        found = LogisticRegression().fit(x[:, kept], right, sample_weight=weights)
        if (found.coef_[0] >= 0).all():
            slopes = np.zeros(x.shape[1])
            slopes[kept] = found.coef_[0]
            return float(found.intercept_[0]), tuple(slopes.tolist())
        # more evidence never speaks against a fix: where it seems so, wrong ones are too few to tell
        kept.pop(int(np.argmin(found.coef_[0])))
    return float(np.log(weights[right].sum() / weights[~right].sum())), (0.0,) * x.shape[1]
