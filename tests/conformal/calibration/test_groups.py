"""Split conformal calibration on groups, and the joint threshold of scores that need no scale."""

import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import ConformalError, QuantileBins, SplitConformal, grouped_quantile


def labels(n, seed=0):
    return np.random.default_rng(seed).integers(0, 12, n)


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_thresholds_are_grouped_quantiles_column_by_column(problem, joint):
    bins, proba, y = problem(3, n=80)
    group = labels(80)
    cal = SplitConformal(bins, "0.3", "hpd", joint).calibrate(proba, y, group)
    columns = cal.scores_.max(axis=1, keepdims=True) if joint == "max" else cal.scores_
    rate = 0.15 if joint == "bonferroni" else 0.3
    parts = [columns[group == g] for g in np.unique(group)]
    expected = [grouped_quantile([p[:, j] for p in parts], str(rate)) for j in range(columns.shape[1])]
    np.testing.assert_array_equal(cal.thresholds_, np.broadcast_to(expected, 2))
    assert cal.n_units == len(np.unique(group))


@pytest.mark.parametrize("joint", ["none", "max"])
def test_groups_of_one_are_no_groups(problem, joint):
    bins, proba, y = problem(4, n=60)
    alone = SplitConformal(bins, 0.2, "hpd", joint).calibrate(proba, y)
    ones = SplitConformal(bins, 0.2, "hpd", joint).calibrate(proba, y, np.random.default_rng(0).permutation(60))
    np.testing.assert_array_equal(alone.thresholds_, ones.thresholds_)
    np.testing.assert_array_equal(alone.p_values(proba, y), ones.p_values(proba, y))
    assert (ones.rank, ones.n_units) == (alone.rank, alone.n_units)


def test_another_rate_keeps_the_groups(problem):
    bins, proba, y = problem(5, n=80)
    group = labels(80)
    cal = SplitConformal(bins, 0.2, "hpd", "max").calibrate(proba, y, group)
    other = cal.at(0.4)
    np.testing.assert_array_equal(other.groups_, group)
    again = SplitConformal(bins, 0.4, "hpd", "max").calibrate(proba, y, group)
    np.testing.assert_array_equal(other.thresholds_, again.thresholds_)
    assert cal.alpha == 0.2  # as it was


@pytest.mark.parametrize("alpha", [0.1, 0.25, 0.5])
def test_a_value_is_in_its_set_if_its_p_value_exceeds_alpha(problem, alpha):
    bins, proba, y = problem(6, n=200)
    cal = SplitConformal(bins, alpha, "hpd").calibrate(proba[:90], y[:90], labels(90))
    np.testing.assert_array_equal(cal.predict(proba).contains(y), cal.p_values(proba, y) > alpha)


def test_groups_need_one_label_per_sample(problem):
    bins, proba, y = problem(0, n=20)
    with pytest.raises(ConformalError, match="one label per sample"):
        SplitConformal(bins).calibrate(proba, y, [1, 2])


def draws(rng, bins, shape):
    """Rows of probabilities, and values from them: within a bin, any is as likely as any other."""
    proba = rng.dirichlet(np.ones(bins.sizes[0]), size=(*shape, bins.n_targets))
    code = (rng.random((*shape, bins.n_targets, 1)) > np.cumsum(proba, axis=-1)[..., :-1]).sum(axis=-1)
    return proba, code + rng.random(code.shape)


def test_one_threshold_over_all_targets_needs_no_scale_and_nine_samples():
    bins = QuantileBins.from_edges([np.arange(7.0)] * 3)
    proba, y = draws(np.random.default_rng(0), bins, (9,))
    cal = SplitConformal(bins, 0.1, "hpd", "max").calibrate(proba, y)
    assert np.isfinite(cal.thresholds_).all()
    assert len(set(cal.thresholds_.tolist())) == 1
    few = SplitConformal(bins, 0.1, "hpd", "max").calibrate(proba[:8], y[:8])
    assert few.predict(proba).unbounded.all()


@pytest.mark.parametrize("n", [9, 30])
def test_all_targets_are_covered_at_once_as_the_exact_law_says(n):
    rng = np.random.default_rng(7)
    bins = QuantileBins.from_edges([np.arange(7.0)] * 3)
    m, repeats = 15, 1200
    counts = np.empty(repeats, dtype=int)
    for i in range(repeats):
        proba, y = draws(rng, bins, (n + m,))
        cal = SplitConformal(bins, 0.1, "hpd", "max").calibrate(proba[:n], y[:n])
        counts[i] = cal.predict(proba[n:]).contains(y[n:], joint=True).sum()
    law = stats.betabinom(m, cal.rank, n + 1 - cal.rank)
    cells = np.searchsorted(law.cdf(np.arange(m)), np.arange(0.1, 0.95, 0.1))  # some ten of like mass
    edges = np.unique(np.concatenate(([-0.5], cells + 0.5, [m + 0.5])))
    expected = np.diff(law.cdf(edges)) * repeats
    assert stats.chisquare(np.histogram(counts, edges)[0], expected).pvalue > 0.001


def test_a_random_member_of_a_new_group_is_covered():
    rng = np.random.default_rng(8)
    bins = QuantileBins.from_edges([np.arange(7.0)] * 2)
    held, repeats = 0, 600
    for _ in range(repeats):
        sizes = rng.integers(1, 7, 12)
        group = np.repeat(np.arange(12), sizes)
        proba, y = draws(rng, bins, (len(group),))
        strange = rng.random(12)[group] < 0.3  # whole groups of which the probabilities say nothing
        y[strange] = rng.uniform(0, 6, (strange.sum(), 2))
        new = rng.choice(np.flatnonzero(group == 11))
        known = group < 11
        cal = SplitConformal(bins, 0.2, "hpd", "max").calibrate(proba[known], y[known], group[known])
        held += int(cal.predict(proba[new : new + 1]).contains(y[new : new + 1], joint=True)[0])
    assert held >= stats.binom.ppf(0.001, repeats, 0.8)
