from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from conformodal.conformal import conformal_rank, coverage_band, grouped_coverage_band, hierarchical_quantile

GROUPS = st.lists(st.lists(st.integers(0, 12), min_size=1, max_size=6), min_size=2, max_size=9)


@settings(deadline=None, max_examples=100)
@given(GROUPS, st.integers(1, 99))
def test_the_guarantee_holds_exactly_for_exchangeable_groups(groups, percent):
    """Given the groups, each is the new one with the same probability: the law is a finite sum, compared exactly."""
    alpha, rate = f"0.{percent:02d}", Fraction(percent, 100)
    member = Fraction(0)
    for k, new in enumerate(groups):
        others = groups[:k] + groups[k + 1 :]
        limit = hierarchical_quantile(others, alpha)
        member += Fraction(sum(s <= limit for s in new), len(new) * len(groups))
    assert member >= 1 - rate


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 10_000), st.integers(2, 30), st.integers(1, 99))
def test_it_is_no_larger_than_it_must_be(seed, n_groups, percent):
    """Without ties coverage is exact to within one member's weight of the new total, and the group at infinity."""
    rng = np.random.default_rng(seed)
    groups = [rng.random(rng.integers(1, 8)) for _ in range(n_groups)]
    limit = hierarchical_quantile(groups, f"0.{percent:02d}")
    below = sum(Fraction(int((g < limit).sum()), g.size) for g in groups) / (n_groups + 1)
    assert below < 1 - Fraction(percent, 100)


def test_too_few_groups_give_infinity_however_many_members():
    assert hierarchical_quantile([np.zeros(1000)] * 18, "0.05") == np.inf
    assert hierarchical_quantile([np.zeros(1000)] * 19, "0.05") == 0
    assert hierarchical_quantile([], 0.5) == np.inf


@pytest.mark.parametrize("seed", range(20))
def test_category_members_keep_the_group_guarantee(seed):
    """Every group in turn is the new one: its members of a category miss with their share of alpha at most, exactly."""
    rng = np.random.default_rng(seed)
    alpha = Fraction(int(rng.integers(1, 9)), 10)
    groups = []  # scores and categories; categories and difficulty go together, and differ from group to group
    for _ in range(int(rng.integers(3, 15))):
        kinds = rng.random(int(rng.integers(1, 6))) < rng.random()
        groups.append((np.round(rng.normal(kinds * 2.0, 1.0), 1), kinds))
    for kind in (False, True):
        weight, missed = Fraction(0), Fraction(0)
        for new, (scores, kinds) in enumerate(groups):
            rest = [g for k, g in enumerate(groups) if k != new and (g[1] == kind).any()]
            members, sizes = [s[k == kind] for s, k in rest], [len(s) for s, _ in rest]
            threshold = hierarchical_quantile(members, alpha, sizes)
            weight += Fraction(int((kinds == kind).sum()), len(scores))
            missed += Fraction(int((scores[kinds == kind] > threshold).sum()), len(scores))
        assert missed <= alpha * weight


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


def test_groups_without_a_threshold_are_always_covered():
    assert grouped_coverage_band([(0, 3), (8, 4)], 0.1) == (1.0, 1.0)
    low, high = coverage_band(50, 10, 0.1)
    found = grouped_coverage_band([(50, 10), (8, 30)], 0.1)
    np.testing.assert_allclose(found, ((10 * low + 30) / 40, (10 * high + 30) / 40))
    assert grouped_coverage_band([(50, 10), (8, 0), (60, 0)], 0.1) == (low, high)  # nobody in them
