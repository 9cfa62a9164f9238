"""Whether p-values are as uniform as those of exchangeable samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import as_count, as_doubles, as_random
from conformodal.conformal.errors import ConformodalError
from conformodal.core.arrays import BoolArray, FloatArray, IntArray

# samples of either kind that are tested; of more, as many drawn at random
_MOST_TESTED = 2000


@dataclass(frozen=True)
class UniformityCheck:
    """Distance of the test p-values from uniformity, and the probability of as much by chance."""

    distance: float  # between the distribution functions of the p-values and of the uniform distribution
    p_value: float  # of the hypothesis that calibration and test samples are exchangeable
    p_values: FloatArray  # (n_test,) conformal p-values, ties broken at random, sorted
    n_calibration: int  # samples behind `distance` and `p_value`: at most 2000 each, drawn at random
    n_test: int


def check_uniformity(
    calibration_scores: npt.ArrayLike, test_scores: npt.ArrayLike, repeats: int = 999, random_state: Any = 0
) -> UniformityCheck:
    """Test whether test scores (m,) rank among calibration scores (n,) as exchangeable samples would.

    All test samples share one calibration set, so that their p-values are dependent and the usual tests of uniformity
    reject too often. Exchangeable samples without ties are in every order equally often; the distance is simulated from
    that in `repeats` random orders, and the p-value is exact. Ties are broken at random. Of more than 2000 calibration
    or test samples 2000 are drawn.

    Source: Bates, Candes, Lei, Romano and Sesia (2023) on the dependence; Dwass (1957) on Monte Carlo p-values.
    """
    old, new = as_doubles(calibration_scores, "calibration_scores"), as_doubles(test_scores, "test_scores")
    for name, scores in (("calibration_scores", old), ("test_scores", new)):
        if scores.ndim != 1 or scores.size == 0 or np.isnan(scores).any():
            raise ConformodalError(f"{name} must be a vector without NaN, at least one score, got shape {scores.shape}")
    repeats, random = as_count(repeats, "repeats", 1), as_random(random_state)
    p_values = np.sort((1 + _ranked(old, new, random)[1]) / (old.size + 1))
    old, new = (random.choice(s, min(s.size, _MOST_TESTED), replace=False) for s in (old, new))
    is_new, larger = _ranked(old, new, random)
    n = old.size
    observed = _distance(larger, n)
    simulated = [_distance(_larger(random.permutation(is_new), n), n) for _ in range(repeats)]
    extreme = 1 + int(np.sum(np.array(simulated) >= observed))
    return UniformityCheck(observed, extreme / (repeats + 1), p_values, n, new.size)


def _ranked(old: FloatArray, new: FloatArray, random: np.random.RandomState) -> tuple[BoolArray, IntArray]:
    """Which of all scores (n + m,), in their order, are new, ties broken at random; and what :func:`_larger` gives."""
    is_new = np.arange(old.size + new.size) >= old.size
    ranked = is_new[np.lexsort((random.random_sample(is_new.size), np.concatenate((old, new))))]
    return ranked, _larger(ranked, old.size)


def _larger(is_new: BoolArray, n: int) -> IntArray:
    """For every new sample, in the order of the scores, how many calibration scores are larger."""
    return np.asarray(n - np.cumsum(~is_new)[is_new])


def _distance(larger: IntArray, n: int) -> float:
    """Largest distance between the share of p-values at most t and t, over the values ``t = j / (n + 1)``."""
    share = np.cumsum(np.bincount(larger, minlength=n + 1)) / larger.size
    return float(np.abs(share - np.arange(1, n + 2) / (n + 1)).max())
