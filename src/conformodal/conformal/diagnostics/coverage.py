"""Coverage on test samples, overall, by group and by set size, compared with the central band of its exact
distribution.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Alpha, as_count, as_doubles, as_flags, as_labels, as_number, factorise
from conformodal.conformal.errors import ConformodalError
from conformodal.conformal.rank import conformal_rank


@dataclass(frozen=True)
class CoverageCheck:
    """Observed coverage and the central band of its exact distribution; for an example see :func:`check_coverage`.

    With n calibration samples, rank k and m test samples, all exchangeable and without ties, the number of covered test
    samples follows BetaBinomial(m, k, n + 1 - k).

    Attributes
    ----------
    n_covered, n_test, n_calibration, rank
        The counts.
    low, high
        Ends of the central band, as shares of the test samples.
    level
        Probability that the observed share falls in [low, high] if the samples are exchangeable.
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
    return grouped_coverage_band([(n_calibration, as_count(n_test, "n_test", 1))], alpha, level)


def grouped_coverage_band(groups: Sequence[tuple[int, int]], alpha: Alpha, level: float = 0.99) -> tuple[float, float]:
    """Central band of the coverage over the test samples of several groups, each with its own threshold.

    Counts of groups are independent, so that their sum has the convolution of Beta-binomial distributions. With one
    group it is :func:`coverage_band`. `groups` are pairs of numbers of calibration and test samples; groups without
    a finite threshold are always covered.

    Examples
    --------
    >>> from conformodal.conformal import grouped_coverage_band
    >>> grouped_coverage_band([(1000, 500), (300, 500)], alpha=0.1)
    (0.862, 0.933)
    """
    try:
        groups = [(as_count(n, "calibration samples"), as_count(m, "test samples")) for n, m in groups]
    except (TypeError, ValueError) as exc:
        raise ConformodalError(f"groups must hold pairs of numbers of samples: {exc}") from None
    n_test = sum(m for _, m in groups)
    if n_test < 1:
        raise ConformodalError(f"a coverage band needs test samples, got {list(groups)}")
    level = as_number(level, "level", "strictly between 0 and 1", lambda p: 0 < p < 1)
    from scipy.stats import betabinom  # noqa: PLC0415 - half a second to import

    law, always = np.ones(1), 0
    for n, m in groups:
        k = conformal_rank(n, alpha)
        if k > n:
            always += m
        elif m:
            law = np.convolve(law, betabinom(m, k, n + 1 - k).pmf(np.arange(m + 1)))
    below = np.cumsum(law)
    tail = (1 - level) / 2
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
    arr = as_flags(inside, "inside", 1)
    if arr.size == 0:
        raise ConformodalError(f"inside must be a vector with at least one sample, got shape {arr.shape}")
    low, high = coverage_band(n_calibration, arr.size, alpha, level)
    rank = conformal_rank(n_calibration, alpha)
    return CoverageCheck(int(arr.sum()), arr.size, n_calibration, rank, low, high, level)


def coverage_by_group(
    inside: npt.ArrayLike,
    groups: npt.ArrayLike,
    n_calibration: int | Mapping[Hashable, int],
    alpha: Alpha,
    level: float = 0.99,
) -> dict[str, CoverageCheck]:
    """Coverage of every group of test samples, for (n_test,) labels `groups`; the rest as in :func:`check_coverage`.

    `n_calibration` are all calibration samples, or by label those of each group if each has its own threshold.

    Split conformal prediction guarantees nothing for a group alone. The band is that of a group chosen in advance whose
    scores are distributed like all others: coverage outside it shows that the group differs. Of G groups about
    ``G (1 - level)`` fall outside by chance.
    """
    held = as_flags(inside, "inside", 1)
    labels, codes = factorise(as_labels(groups, held.size))
    sizes = n_calibration if isinstance(n_calibration, Mapping) else dict.fromkeys(labels, n_calibration)
    return {
        str(label): check_coverage(held[codes == k], sizes.get(label, 0), alpha, level)
        for k, label in enumerate(labels)
    }


def coverage_by_size(
    inside: npt.ArrayLike,
    sizes: npt.ArrayLike,
    n_calibration: int,
    alpha: Alpha,
    strata: int = 5,
    level: float = 0.99,
) -> dict[str, CoverageCheck]:
    """Coverage by set size, in strata of about equal numbers of samples.

    `sizes` (n_test,) are lengths or volumes; the rest is as in :func:`check_coverage`, and the band as in
    :func:`coverage_by_group`. Sets that are too small show as strata below their bands. Equal sizes share a stratum, so
    there may be fewer than `strata`.

    Source: Angelopoulos, Bates, Malik and Jordan (2021), size-stratified coverage.
    """
    held, values = as_flags(inside, "inside", 1), as_doubles(sizes, "sizes")
    if values.shape != held.shape:
        raise ConformodalError(f"sizes must have shape {held.shape}, one per sample, got {values.shape}")
    if np.isnan(values).any():
        raise ConformodalError("sizes must not hold NaN")
    strata = as_count(strata, "strata", 1)
    values = np.array([float(f"{v:.12g}") for v in values])  # sums of the same widths in another order are one size
    ranked = np.sort(values)
    strata = min(strata, max(values.size, 1))
    cuts = np.unique(ranked[(np.arange(1, strata) * values.size) // strata])
    stratum = np.searchsorted(cuts, values, side="right")
    checks = {}
    for s in np.unique(stratum):
        rows = stratum == s
        low, high = values[rows].min(), values[rows].max()
        name = f"{low:.4g} to {high:.4g}" if low < high else f"{low:.4g}"
        name = name if name not in checks else f"{low!r} to {high!r}"
        checks[name] = check_coverage(held[rows], n_calibration, alpha, level)
    return checks
