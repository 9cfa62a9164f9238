"""A bet against exchangeability: uniform p-values, rare false alarms, and alarms after a shift."""

import numpy as np
import pytest
from scipy.stats import kstest

from conformodal.conformal import ConformodalError, ExchangeabilityMartingale, unit_scores


def test_p_values_are_uniform_and_independent():
    """Of exchangeable scores, also where they tie."""
    rng = np.random.default_rng(20)
    for scores in (rng.normal(size=3000), rng.integers(0, 3, 3000).astype(float), np.zeros(3000)):
        p = ExchangeabilityMartingale(scores[:500], seed=1).update(scores[500:]).p_values_
        assert kstest(p, "uniform").pvalue > 1e-3
        assert abs(np.corrcoef(p[1:], p[:-1])[0, 1]) < 0.06


def test_p_value_breaks_ties_at_random():
    """It counts the larger scores and a random part of the equal ones."""
    one = ExchangeabilityMartingale([1.0, 2.0, 2.0, 3.0], seed=3).update([2.0])
    tie = np.random.default_rng(3).random()
    assert one.p_values_[0] == pytest.approx((1 + 3 * tie) / 5)


def test_new_scores_join_the_reference_sample():
    parts, whole = ExchangeabilityMartingale(seed=5), ExchangeabilityMartingale(seed=5)
    scores = np.random.default_rng(5).normal(size=40)
    for score in scores:
        parts.update([score])
    np.testing.assert_array_equal(parts.values_, whole.update(scores).values_)
    assert parts.p_values_[1] == pytest.approx(0.5 * ((scores[0] > scores[1]) + _tie(5, 1)))


def _tie(seed, number):
    return np.random.default_rng(seed).random(number + 1)[number]


@pytest.mark.parametrize("larger_only", [False, True])
def test_false_alarms_are_at_most_as_frequent_as_the_level(larger_only):
    # at a level of 0.2, so that 400 sequences tell: more than 103 alarms have a probability of 0.3 %
    rng = np.random.default_rng(21)
    alarms = 0
    for seed in range(400):
        scores = rng.exponential(size=160).round(1)
        one = ExchangeabilityMartingale(scores[:40], level=0.2, larger_only=larger_only, seed=seed)
        alarms += one.update(scores[40:]).alarm_ is not None
    assert 0 < alarms <= 103


def test_the_expected_capital_is_one():
    rng, ends = np.random.default_rng(22), []
    for seed in range(2000):
        ends.append(ExchangeabilityMartingale(seed=seed).update(rng.normal(size=12)).values_[-1])
    assert abs(np.mean(ends) - 1) < 4 * np.std(ends) / np.sqrt(len(ends))


def test_larger_scores_raise_an_alarm_that_says_so():
    rng = np.random.default_rng(23)
    one = ExchangeabilityMartingale(rng.normal(size=100)).update(rng.normal(size=50))
    assert one.alarm_ is None
    assert one.update(rng.normal(2, 1, size=50)).alarm_ in range(50, 90)
    assert one.larger_
    assert one.values_[one.alarm_] >= 100 > one.values_[: one.alarm_].max()


def test_two_sided_bet_detects_smaller_scores():
    rng = np.random.default_rng(24)
    before, after = rng.normal(size=100), rng.normal(-2, 1, size=60)
    both = ExchangeabilityMartingale(before).update(after)
    assert both.alarm_ is not None
    assert not both.larger_
    assert ExchangeabilityMartingale(before, larger_only=True).update(after).alarm_ is None


def test_scores_are_ranked_within_their_group():
    rng = np.random.default_rng(25)
    groups = np.tile(["near", "far"], 100)
    scores = rng.normal(size=200) + 10 * (groups == "far")
    order = np.argsort(groups[100:], kind="stable") + 100  # in the new ones, one group after the other
    one = ExchangeabilityMartingale(scores[:100], groups[:100]).update(scores[order], groups[order])
    assert one.alarm_ is None
    assert ExchangeabilityMartingale(scores[:100]).update(scores[order]).alarm_ is not None


def test_infinite_scores_count_as_the_worst_and_nan_is_refused():
    one = ExchangeabilityMartingale([0.1, np.inf]).update([np.inf, 0.2])
    assert one.p_values_[0] < 2 / 3
    with pytest.raises(ConformodalError, match="must not hold NaN"):
        one.update([np.nan])
    with pytest.raises(ConformodalError, match="groups must be None"):
        one.update([1.0], ["a"])
    with pytest.raises(ConformodalError, match="level must"):
        ExchangeabilityMartingale(level=2)


def test_a_unit_scores_what_would_have_covered_its_own_samples():
    labels, scores = unit_scores([3, 1, 2, 9, 5, 4], ["b", "b", "b", "b", "a", "a"], 0.25)
    assert labels.tolist() == ["a", "b"]
    assert scores.tolist() == [5, 3]
    assert unit_scores(np.arange(10.0), np.zeros(10), 0.1)[1].tolist() == [8]
