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
_MEDIAN_OF_NORM3 = 1.5382
_WRONG = 5.0  # a fix off by more spreads than that is altogether wrong


@dataclass(frozen=True)
class FixScale:
    """How errors of fixes depend on their claims.

    Attributes
    ----------
    position, position_growth
        Spread in metres: the first, times the claim to the power of the second.
    rotation, rotation_growth
        The same in radians.
    trust_offset, trust_slope
        Log odds that a fix is right: the first, plus the second times the logarithm of what speaks for it.
    """

    position: float
    position_growth: float
    rotation: float
    rotation_growth: float
    trust_offset: float
    trust_slope: float

    def apply(self, fix: PoseFix, evidence: float) -> PoseFix:
        """The fix with spreads of the size of its errors; its own are its claims."""
        odds = self.trust_offset + self.trust_slope * float(np.log(evidence))
        return replace(
            fix,
            sigma_m=self.position * fix.sigma_m**self.position_growth,
            sigma_rad=self.rotation * fix.sigma_rad**self.rotation_growth,
            trust=float(1 / (1 + np.exp(-odds))),
        )


@dataclass(frozen=True, eq=False)
class FixErrors:
    """Errors of m fixes, in metres and radians, beside what they claimed and what spoke for them; all (m,)."""

    off_m: FloatArray
    claim_m: FloatArray
    off_rad: FloatArray
    claim_rad: FloatArray
    evidence: FloatArray


def fit_fix_scale(errors: FixErrors, same_place_m: float) -> FixScale | None:
    """Learn the scale; None from fewer than twenty fixes.

    Parameters
    ----------
    errors
        Of fixes that did not know the truth.
    same_place_m
        A fix further off is at another place: its error is the distance between the two.
    """
    here = errors.off_m < same_place_m
    if here.sum() < _LEAST_FIXES:
        return None
    position, growth = _scale(errors.off_m[here], errors.claim_m[here])
    rotation, turn_growth = _scale(errors.off_rad[here], errors.claim_rad[here])
    right = here & (errors.off_m < _WRONG * _MEDIAN_OF_NORM3 * position * errors.claim_m**growth)
    offset, slope = _trust(np.log(errors.evidence), right)
    return FixScale(position, growth, rotation, turn_growth, offset, slope)


def _scale(errors: FloatArray, claims: FloatArray) -> tuple[float, float]:
    growth = fit_growth(errors, claims)
    return max(float(np.median(errors / claims**growth)) / _MEDIAN_OF_NORM3, 1e-6), growth


def _trust(log_evidence: FloatArray, right: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Offset and slope of the log odds of being right; one more of each kind, so that neither is certain."""
    middle = float(np.median(log_evidence))
    x = np.concatenate((log_evidence, [middle, middle]))[:, None]
    right = np.concatenate((right, [True, False]))
    found = LogisticRegression().fit(x, right)
    slope = float(found.coef_[0, 0])
    if slope < 0:  # more evidence never speaks against a fix: where it seems so, wrong ones are too few to tell
        return float(np.log(right.sum() / (~right).sum())), 0.0
    return float(found.intercept_[0]), slope
