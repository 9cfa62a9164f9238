"""Coverage on test samples, compared with the central band of its exact distribution; the worst strip of the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import SHARE, Alpha, as_finite, check_number
from .rank import conformal_rank

_COUNT = Range(0, whole=True)
# samples that choose the slab, drawn at random; half of all if these are fewer
_MOST_CHOOSE = 2000
# random directions, and the least share of the choosing samples in a slab
_DIRECTIONS, _LEAST_SHARE = 500, 0.2


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


def strata_of(sizes: FloatArray, most: int = 5) -> list[tuple[str, BoolArray]]:
    """Samples (n,) in up to five strata of about equal numbers, by the sizes of their sets; equal sizes stay together.

    Source: Angelopoulos, Bates, Malik and Jordan (2021), size-stratified coverage.
    """
    values = np.array([float(f"{v:.12g}") for v in sizes])  # sums of the same widths in another order are one size
    cuts = np.unique(np.sort(values)[(np.arange(1, most) * values.size) // most])
    stratum = np.searchsorted(cuts, values, side="right")
    strata = []
    for rows in (stratum == s for s in np.unique(stratum)):
        low, high = values[rows].min(), values[rows].max()
        strata.append((f"{low:.4g} to {high:.4g}" if low < high else f"{low:.4g}", rows))
    return strata


def worst_slab(inside: BoolArray, X: npt.ArrayLike, random_state: Any = 0) -> IntArray:
    """Samples in the slab of lowest coverage, of the half of the samples that did not choose it.

    A slab is a strip of the inputs `X` (n, p) in any direction; random directions and the axes are searched. The
    minimum over many slabs is far below the coverage of any one, but the second half is independent of the choice: its
    coverage has the band of a slab chosen in advance.

    Source: Cauchois, Gupta and Duchi (2021); split in two as by Romano, Sesia and Candes (2020).
    """
    from sklearn.utils import check_random_state  # noqa: PLC0415 - half a second to import

    inputs = as_finite(X, "X", "(n, p)")
    if len(inputs) != len(inside):
        raise ConformodalError(f"X must have one row per test sample ({len(inside)}), got {len(inputs)}")
    random, spread = check_random_state(random_state), inputs.std(axis=0)
    scaled = np.divide(inputs, spread, out=np.zeros_like(inputs), where=spread > 0)
    first, second = np.split(random.permutation(len(inputs)), [min(len(inputs) // 2, _MOST_CHOOSE)])
    directions = random.standard_normal((_DIRECTIONS, inputs.shape[1]))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    least = max(1, int(np.ceil(_LEAST_SHARE * first.size)))
    slabs = []
    for direction in (*np.eye(inputs.shape[1]), *directions):
        at = scaled[first] @ direction
        ranked = np.argsort(at, kind="stable")
        start, stop = lowest_run(inside[first[ranked]], least)
        slabs.append((inside[first[ranked[start:stop]]].mean(), at[ranked[start]], at[ranked[stop - 1]], direction))
    _, low, high, direction = min(slabs, key=lambda slab: slab[0])
    at = scaled[second] @ direction
    return np.asarray(second[(low <= at) & (at <= high)])


def lowest_run(values: AnyArray, least: int) -> tuple[int, int]:
    """Start and stop of the run of at least `least` values with the smallest mean, exactly.

    Dinkelbach's iteration: for a guess of the mean, the run whose sum falls furthest below it gives the next guess.
    """
    total = np.concatenate(([0.0], np.cumsum(values, dtype=np.float64)))
    steps = np.arange(total.size)
    start, stop = 0, values.size
    while True:
        mean = (total[stop] - total[start]) / (stop - start)
        excess = total - mean * steps
        highest = np.maximum.accumulate(excess[: total.size - least])
        gain = excess[least:] - highest
        at = int(gain.argmin())
        if gain[at] >= -1e-9:
            return start, stop
        stop = at + least
        start = int(excess[: at + 1].argmax())
