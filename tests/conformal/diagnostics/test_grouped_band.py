import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import ConformalError, conformal_rank, coverage_band, grouped_coverage_band


@pytest.mark.parametrize("alpha", [0.1, 0.25])
@pytest.mark.parametrize("level", [0.9, 0.99])
def test_one_group_is_the_plain_band(alpha, level):
    for n, m in ((9, 1), (20, 7), (200, 80)):
        assert grouped_coverage_band([(n, m)], alpha, level) == coverage_band(n, m, alpha, level)


def test_two_groups_are_the_sum_over_all_pairs_of_counts():
    groups, alpha, level = [(12, 8), (31, 5)], 0.1, 0.95
    ranks = [conformal_rank(n, alpha) for n, _ in groups]
    laws = [stats.betabinom(m, k, n + 1 - k) for (n, m), k in zip(groups, ranks, strict=True)]
    law = np.zeros(14)
    for a in range(9):
        for b in range(6):
            law[a + b] += laws[0].pmf(a) * laws[1].pmf(b)
    below = np.cumsum(law)
    low = next(c for c in range(14) if below[c] >= 0.025)
    high = next(c for c in range(14) if below[c] >= 0.975)
    assert grouped_coverage_band(groups, alpha, level) == (low / 13, high / 13)


def test_the_band_holds_what_a_simulation_counts():
    rng = np.random.default_rng(0)
    groups, alpha, repeats = [(15, 20), (40, 10), (5, 4)], 0.2, 4000
    counts = np.full(repeats, 0)
    for n, m in groups:
        k = conformal_rank(n, alpha)
        limit = np.sort(rng.random((repeats, n)), axis=1)[:, k - 1 : k] if k <= n else np.ones((repeats, 1))
        counts += (rng.random((repeats, m)) <= limit).sum(axis=1)
    low, high = grouped_coverage_band(groups, alpha, 0.9)
    held = np.mean((counts / 34 >= low) & (counts / 34 <= high))
    assert held > 0.9 - 3 * np.sqrt(0.09 / repeats)  # at least: counts are whole
    assert np.mean(counts / 34 < low) < 0.05 + 3 * np.sqrt(0.05 / repeats)


def test_groups_without_a_threshold_are_always_covered():
    assert grouped_coverage_band([(0, 3), (8, 4)], 0.1) == (1.0, 1.0)
    low, high = coverage_band(50, 10, 0.1)
    found = grouped_coverage_band([(50, 10), (8, 30)], 0.1)
    np.testing.assert_allclose(found, ((10 * low + 30) / 40, (10 * high + 30) / 40))
    assert grouped_coverage_band([(50, 10), (8, 0), (60, 0)], 0.1) == (low, high)  # nobody in them


def test_errors():
    with pytest.raises(ConformalError, match="needs test samples"):
        grouped_coverage_band([(9, 0)], 0.1)
    with pytest.raises(ConformalError, match="level"):
        grouped_coverage_band([(9, 3)], 0.1, 1.0)
