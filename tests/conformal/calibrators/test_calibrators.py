import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import conformodal.conformal as cm

SCORES = ["lac", "density", "aps", "hpd_random"]


@settings(deadline=None, max_examples=80)
@given(
    st.integers(0, 10_000),
    st.sampled_from(SCORES),
    st.sampled_from(["none", "bonferroni", "max"]),
    st.sampled_from([0.1, 0.33, 0.7]),
    st.sampled_from([np.float32, np.float64]),
)
def test_membership_is_score_at_most_threshold(problem, seed, score, joint, alpha, dtype):
    bins, proba, y = problem(seed, n=80, dtype=dtype)
    cal = cm.SplitConformal(bins, alpha, score, joint).fit_scale(proba[60:], y[60:]).calibrate(proba[:50], y[:50])
    scores = cal.score_samples(proba, y)
    for p in (proba, [proba[:, j] for j in range(2)]):
        np.testing.assert_array_equal(cal.predict(p).contains(y), scores <= cal.thresholds_)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(SCORES))
@example(130, "lac")  # so many values outside the edges that one target's threshold is infinite, the other's not
def test_one_group_equal_weights_and_one_fold_are_split_conformal(problem, seed, score):
    bins, proba, y = problem(seed, n=80)
    split = cm.SplitConformal(bins, 0.2, score).calibrate(proba[:40], y[:40]).predict(proba[40:])
    same = np.full(40, 0.1)
    others = [
        cm.MondrianConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict(proba[40:], same),
        cm.WeightedConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict(proba[40:], same),
        cm.ConditionalConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict(proba[40:], same),
        cm.CrossConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict({0.1: proba[40:]}),
    ]
    for other in others:
        np.testing.assert_array_equal(other.unbounded, split.unbounded)
        for a, b in zip(other.masks, split.masks, strict=True):
            np.testing.assert_array_equal(a, b)


def test_mondrian_falls_back_for_small_groups_only_not_for_groups_that_lie_outside(problem):
    bins, proba, y = problem(0, n=80)
    group = np.repeat([0, 1, 2], [40, 35, 5])
    y[:40, 0] = 1e9
    sets = cm.MondrianConformal(bins, 0.1, fallback="pooled").calibrate(proba, y, group)
    assert sets.fallback_groups == [2]
    np.testing.assert_array_equal(sets.predict(proba[:1], [0]).unbounded, np.isposinf(sets.thresholds_[0])[None])
    assert sets.thresholds_[0][0] == np.inf


@pytest.mark.parametrize("score", ["lac", "density"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("at_once", [True, False])
def test_few_rows_and_many_have_the_same_sets(score, dtype, at_once):
    rng = np.random.default_rng(0)
    y = rng.gamma(2.0, size=(400, 2))
    bins = cm.QuantileBins(12).fit(y)
    proba = rng.dirichlet(np.ones(12), size=(400, 2)).astype(dtype)
    answers = proba if at_once else [np.ascontiguousarray(proba[:, j]) for j in range(2)]
    calibrated = cm.SplitConformal(bins, 0.2, score).calibrate(answers, y)
    many = calibrated.predict(answers)
    for i in range(0, 400, 7):
        few = proba[i : i + 3] if at_once else [part[i : i + 3] for part in answers]
        for j, mask in enumerate(calibrated.predict(few).masks):
            np.testing.assert_array_equal(mask, many.masks[j][i : i + 3])


def in_seven_dimensions(rng, n):
    """Probabilities and values of targets whose scores are of very different sizes."""
    bins = cm.QuantileBins.from_edges([np.arange(6.0) * 10.0**j for j in range(7)])
    return bins, rng.dirichlet(np.ones(5), (n, 7)), rng.uniform(0, 5, (n, 7)) * 10.0 ** np.arange(7)


def test_rows_that_scaled_do_not_calibrate():
    rng = np.random.default_rng(0)
    bins, proba, y = in_seven_dimensions(rng, 40)
    other = rng.permutation(9)
    for kind, extra in (
        (cm.SplitConformal, ()),
        (cm.MondrianConformal, (np.zeros(9),)),
        (cm.WeightedConformal, (np.ones(9),)),
        (cm.ConditionalConformal, (np.ones(9),)),
    ):
        cal = kind(bins, 0.1, "density", "max").fit_scale(proba[:9], y[:9])
        with pytest.raises(cm.ConformodalError, match="fit_scale saw 9 of the 9 calibration rows"):
            cal.calibrate(proba[:9][other], y[:9][other], *extra)
        cal.fit_scale(proba[:30], y[:30])
        with pytest.raises(cm.ConformodalError, match="fit_scale saw"):
            cal.calibrate(proba[:9], y[:9], *extra)
        cal.calibrate(proba[31:], y[31:], *extra)


@pytest.mark.parametrize("score", [*SCORES, "hpd"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_threshold_that_lets_every_bin_in_is_told(score, dtype):
    rng = np.random.default_rng(0)
    bins = cm.QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 2, 8))])
    y = rng.uniform(bins.edges_[0][0], bins.edges_[0][-1], 80)
    proba = rng.dirichlet(np.ones(7), 80).astype(dtype)
    fair = cm.SplitConformal(bins, 0.3, score)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fair.calibrate(proba, y)
    certain = np.zeros_like(proba)
    certain[np.arange(80), rng.integers(0, 7, 80)] = 1
    with pytest.warns(cm.WholeRangeWarning, match="target 0") as seen:
        cal = cm.SplitConformal(bins, 0.3, score).calibrate(certain, y)
    assert seen[0].filename == __file__
    assert cal.predict(certain).masks[0].all()
    with pytest.warns(cm.WholeRangeWarning, match="in group a"):
        cm.MondrianConformal(bins, 0.3, score).calibrate(certain, y, np.repeat("a", 80))
    almost = np.where(np.arange(80)[:, None] < 20, certain, proba)
    calm = cm.SplitConformal(bins, 0.5, score).calibrate(almost, y)
    with pytest.warns(cm.WholeRangeWarning):
        calm.at(0.05)


def labels(n, seed=0):
    return np.random.default_rng(seed).integers(0, 12, n)


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
def test_thresholds_are_grouped_quantiles_column_by_column(problem, joint):
    bins, proba, y = problem(3, n=80)
    group = labels(80)
    cal = cm.SplitConformal(bins, "0.3", "hpd", joint).calibrate(proba, y, group)
    columns = cal.scores_.max(axis=1, keepdims=True) if joint == "max" else cal.scores_
    rate = 0.15 if joint == "bonferroni" else 0.3
    parts = [columns[group == g] for g in np.unique(group)]
    expected = [cm.hierarchical_quantile([p[:, j] for p in parts], str(rate)) for j in range(columns.shape[1])]
    np.testing.assert_array_equal(cal.thresholds_, np.broadcast_to(expected, 2))
    assert cal.n_units == len(np.unique(group))
