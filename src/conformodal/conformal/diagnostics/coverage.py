"""Checking a promise: coverage beside the band that chance alone explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from ..checks import Alpha
from ..errors import ConformalError
from ..rank import conformal_rank


@dataclass(frozen=True)
class CoverageCheck:
    """Observed coverage and the central band of its exact law.

    With n calibration samples, rank k and m test samples, all exchangeable and without ties, the number of
    covered test samples follows BetaBinomial(m, k, n + 1 - k).

    Attributes
    ----------
    n_covered, n_test, n_calibration, rank
        The counts.
    low, high
        Ends of the central band, as shares of the test samples.
    level
        Probability that the observed share falls in [low, high] if the promise's assumptions hold.
    """

    n_covered: int
    n_test: int
    n_calibration: int
    rank: int
    low: float
    high: float
    level: float

    @property
    def coverage(self) -> float:
        """Share of covered test samples."""
        return self.n_covered / self.n_test

    @property
    def inside(self) -> bool:
        """Whether the observed coverage is one that chance explains."""
        return self.low <= self.coverage <= self.high


def coverage_band(n_calibration: int, n_test: int, alpha: Alpha, level: float = 0.99) -> tuple[float, float]:
    """Central band of the coverage over `n_test` samples, as shares: exact Beta-binomial quantiles.

    Raises
    ------
    ConformalError
        If `n_test` is below 1 or `level` outside (0, 1).
    """
    if n_test < 1:
        raise ConformalError(f"n_test must be at least 1, got {n_test}")
    if not 0 < level < 1:
        raise ConformalError(f"level must lie strictly between 0 and 1, got {level}")
    k = conformal_rank(n_calibration, alpha)
    if k > n_calibration:
        return 1.0, 1.0
    law = stats.betabinom(n_test, k, n_calibration + 1 - k)
    tail = (1 - level) / 2
    return float(law.ppf(tail)) / n_test, float(law.ppf(1 - tail)) / n_test


def check_coverage(
    inside: npt.NDArray[np.bool_], n_calibration: int, alpha: Alpha, level: float = 0.99
) -> CoverageCheck:
    """Compare the coverage of one target's test samples with its exact band.

    Parameters
    ----------
    inside
        (n_test,) whether each true value is in its set.
    n_calibration
        Calibration samples behind the threshold.
    alpha
        The rate this target was calibrated at.
    level
        Probability of the central band.
    """
    arr = np.asarray(inside, dtype=bool)
    if arr.ndim != 1 or arr.size == 0:
        raise ConformalError(f"inside must be a vector with at least one sample, got shape {arr.shape}")
    low, high = coverage_band(n_calibration, arr.size, alpha, level)
    rank = conformal_rank(n_calibration, alpha)
    return CoverageCheck(int(arr.sum()), arr.size, n_calibration, rank, low, high, level)
