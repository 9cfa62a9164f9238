"""Coverage on test samples, compared with the central band of its exact distribution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import SHARE, Alpha, check_number
from .rank import conformal_rank

_COUNT = Range(0, whole=True)


@dataclass(frozen=True)
class CoverageCheck:
    """Observed coverage and the central band of its exact distribution; for an example see :func:`check_coverage`.

    With n calibration samples, rank k and m test samples, all exchangeable and without ties, the number of covered test
    samples follows BetaBinomial(m, k, n + 1 - k).
    """

    n_covered: int
    n_test: int
    n_calibration: int
    rank: int
    low: float  # ends of the central band, as shares of the test samples
    high: float
    level: float  # probability that the observed share falls in [low, high] if the samples are exchangeable

    @property
    def coverage(self) -> float:
        """Share of covered test samples."""
        return self.n_covered / self.n_test

    @property
    def inside(self) -> bool:
        """Whether the observed coverage lies in the band."""
        return self.low <= self.coverage <= self.high


def coverage_band(n_calibration: int, n_test: int, alpha: Alpha, level: float = 0.99) -> tuple[float, float]:
    """Central band of the coverage over `n_test` samples, as shares: exact Beta-binomial quantiles.

    Examples
    --------
    >>> from conformodal.conformal import coverage_band
    >>> coverage_band(n_calibration=1000, n_test=1000, alpha=0.1)
    (0.863, 0.932)
    >>> coverage_band(n_calibration=8, n_test=1000, alpha=0.1)  # too few: unbounded, always covered
    (1.0, 1.0)
    """
    return grouped_coverage_band([(n_calibration, n_test)], alpha, level)


def grouped_coverage_band(groups: Sequence[tuple[int, int]], alpha: Alpha, level: float = 0.99) -> tuple[float, float]:
    """Central band of the coverage over the test samples of several groups, each with its own threshold.

    Counts of groups are independent, so that their sum has the convolution of Beta-binomial distributions. With one
    group it is :func:`coverage_band`. `groups` are pairs of numbers of calibration and test samples; groups without
    a finite threshold are always covered.
    """
    n_test = sum(check_number(m, "n_test", _COUNT) for _, m in groups)
    if n_test < 1:
        raise ConformodalError(f"n_test must be at least 1 for a coverage band, got {n_test}")
    tail = (1 - check_number(level, "level", SHARE)) / 2
    from scipy.stats import betabinom  # noqa: PLC0415 - half a second to import

    law, always = np.ones(1), 0
    for n, m in groups:
        k = conformal_rank(n, alpha)
        if k > n:
            always += m
        elif m:
            law = np.convolve(law, betabinom(m, k, n + 1 - k).pmf(np.arange(m + 1)))
    below = np.cumsum(law)
    low, high = (int(np.searchsorted(below, q)) for q in (tail, 1 - tail))
    return (always + low) / n_test, (always + min(high, len(law) - 1)) / n_test


def check_coverage(inside: npt.ArrayLike, n_calibration: int, alpha: Alpha, level: float = 0.99) -> CoverageCheck:
    """Compare the coverage of one target's test samples with its exact band, of probability `level`.

    `inside` (n_test,) says whether each true value is in its set; `n_calibration` samples are behind the threshold.

    Examples
    --------
    >>> from conformodal.conformal import check_coverage
    >>> check = check_coverage([True] * 93 + [False] * 7, n_calibration=200, alpha=0.1)
    >>> check.coverage, check.inside
    (0.93, True)
    """
    held = np.asarray(inside)
    if held.dtype != np.bool_ or held.ndim != 1 or held.size == 0:
        raise ConformodalError(f"inside must be a vector of booleans, at least one, got {held.dtype} {held.shape}")
    low, high = coverage_band(n_calibration, held.size, alpha, level)
    return CoverageCheck(
        int(held.sum()), held.size, n_calibration, conformal_rank(n_calibration, alpha), low, high, level
    )
