import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import NoveltyTest


def test_the_p_value_of_a_tiny_example_worked_by_hand():
    # nearest of another group: 0 -> 3, 1 -> 3, 3 -> 1 (of {4} it is 1 away), 4 -> 3, 9 -> 4
    test = NoveltyTest([[0.0], [1.0], [3.0], [4.0], [9.0]], ["a", "a", "b", "c", "d"])
    np.testing.assert_allclose(test.scores_, [3, 2, 1, 1, 5])
    np.testing.assert_allclose(test.weights_, [0.5, 0.5, 1, 1, 1])
    new = test.scores([[2.9], [6.5], [30.0]])
    np.testing.assert_allclose(new, [0.1, 2.5, 21])
    np.testing.assert_allclose(test.p_values(new), [1, (1 + 0.5 + 1) / 5, 1 / 5])
    # as large is enough
    np.testing.assert_allclose(test.p_values([3.0, 2.0, 5.0]), [(1 + 0.5 + 1) / 5, (1 + 1 + 1) / 5, 2 / 5])
    assert (test.n_units, test.least_p) == (4, 1 / 5)


@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_a_member_of_a_new_group_is_rarely_new(spread):
    """Groups are exchangeable, their members are not: P(p <= u) <= u all the same."""
    rng = np.random.default_rng(1)
    repeats, n_groups = 1500, 19
    p = np.empty(repeats)
    for i in range(repeats):
        sizes = rng.integers(1, 6, n_groups + 1)
        group = np.repeat(np.arange(n_groups + 1), sizes)
        samples = rng.normal(size=(n_groups + 1, 2))[group] + spread * rng.normal(size=(len(group), 2))
        new = rng.choice(np.flatnonzero(group == n_groups))
        test = NoveltyTest(samples[group < n_groups], group[group < n_groups])
        p[i] = test.p_values(test.scores(samples[new : new + 1]))[0]
    for u in (0.05, 0.1, 0.2, 0.5):
        assert (p <= u + 1e-12).sum() <= stats.binom.ppf(0.999, repeats, u)
    # and it is not so by never rejecting
    assert (p <= 0.2).mean() > 0.04


def test_other_places_get_the_least_p_value():
    rng = np.random.default_rng(2)
    test = NoveltyTest(rng.normal(size=(200, 4)), np.arange(200) // 4)
    p = test.p_values(test.scores(rng.normal(size=(10, 4)) + 50))
    np.testing.assert_array_equal(p, test.least_p)  # to the last bit: a level is compared with it
    assert test.least_p == 1 / 51


@pytest.mark.parametrize("seed", range(40))
def test_no_p_value_is_above_one_by_rounding(seed):
    rng = np.random.default_rng(seed)
    groups = np.repeat(np.arange(9), rng.integers(1, 60, 9))
    test = NoveltyTest(rng.normal(size=(len(groups), 2)), groups)
    assert test.p_values(np.zeros(1))[0] == pytest.approx(1)
    assert test.p_values(np.zeros(1))[0] <= 1


def test_left_out_p_values_are_those_of_the_other_groups():
    rng = np.random.default_rng(5)
    references, groups = rng.normal(size=(30, 3)), np.repeat(np.arange(6), 5)
    test = NoveltyTest(references, groups)
    for i in (0, 7, 29):
        others = groups != groups[i]
        shares = [np.mean(test.scores_[groups == g] >= test.scores_[i]) for g in np.unique(groups[others])]
        assert test.left_out_p_values()[i] == pytest.approx((1 + np.sum(shares)) / 7)


def test_novel_scores_do_not_depend_on_a_known_sample():
    """Of n + 1 exchangeable scores: where the new one is not novel, it does not matter which others are."""
    rng = np.random.default_rng(3)
    level, n = 0.15, 19
    for _ in range(50):
        scores = rng.normal(size=n + 1)
        test = NoveltyTest(rng.normal(size=(5, 2)), np.arange(5)).rescored(scores[:n], np.arange(n))
        if test.p_values(scores[n:])[0] <= level:
            continue
        among_all = (scores[None] >= scores[:n, None]).sum(axis=1) / (n + 1) <= level
        np.testing.assert_array_equal(test.left_out_p_values() <= level, among_all)


def test_references_of_a_samples_own_group_do_not_count():
    rng = np.random.default_rng(4)
    known, groups, new = rng.normal(size=(30, 3)), rng.choice(["a", "b", "c"], 30), rng.normal(size=(8, 3))
    own = rng.choice(["a", "b", "d"], 8)
    distances = np.linalg.norm(new[:, None] - known, axis=2)
    distances[own[:, None] == groups] = np.inf
    np.testing.assert_allclose(NoveltyTest(known, groups).scores(new, own), distances.min(axis=1))
