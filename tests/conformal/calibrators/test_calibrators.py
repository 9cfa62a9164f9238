import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

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


@pytest.mark.parametrize(
    ("kind", "extra"),
    [
        (cm.SplitConformal, ()), (cm.MondrianConformal, (np.zeros(9),)),
        (cm.ConditionalConformal, (np.ones(9),)),
    ],
)  # fmt: skip
def test_rows_that_the_scales_have_seen_do_not_calibrate(problem, kind, extra):
    bins, proba, y = problem(0, n=60)
    order = np.random.default_rng(0).permutation(9)
    for scaled in (9, 30):
        calibrator = kind(bins, 0.1, "density", "max").fit_scale(proba[:scaled], y[:scaled])
        with pytest.raises(cm.ConformodalError, match="fit_scale saw 9 of the 9 calibration rows"):
            calibrator.calibrate(proba[order], y[order], *extra)
    calibrator.calibrate(proba[31:40], y[31:40], *extra)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(SCORES))
@example(130, "lac")  # so many values outside the edges that one target's threshold is infinite, the other's not
def test_one_group_is_split_conformal(problem, seed, score):
    bins, proba, y = problem(seed, n=80)
    split = cm.SplitConformal(bins, 0.2, score).calibrate(proba[:40], y[:40]).predict(proba[40:])
    same = np.full(40, 0.1)
    others = [
        cm.MondrianConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict(proba[40:], same),
        cm.ConditionalConformal(bins, 0.2, score).calibrate(proba[:40], y[:40], same).predict(proba[40:], same),
    ]
    for other in others:
        np.testing.assert_array_equal(other.unbounded, split.unbounded)
        for a, b in zip(other.masks, split.masks, strict=True):
            np.testing.assert_array_equal(a, b)


def test_small_new_and_outlying_groups_are_unbounded(problem):
    bins, proba, y = problem(0, n=80)
    y[:40, 0] = 1e9
    sets = cm.MondrianConformal(bins, 0.1).calibrate(proba, y, np.repeat([0, 1, 2], [40, 35, 5]))
    assert sets.small_groups == [2]
    assert sets.predict(proba[:4], [0, 1, 2, 3]).unbounded[:, 0].tolist() == [True, False, True, True]


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
    np.testing.assert_allclose(cal.thresholds_, np.broadcast_to(expected, 2), atol=1e-11)
    assert cal.n_units == len(np.unique(group))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("score", ["lac", "density", "hpd"])
@pytest.mark.parametrize("joint", ["none", "max"])
def test_scores_that_differ_by_rounding_are_tied(dtype, score, joint):
    """Rows of one kind, whose probabilities are rounded in many ways: all have the same sets, as have exact ones."""
    rng = np.random.default_rng(0)
    bins = cm.QuantileBins.from_edges([np.arange(7.0)])
    exact = np.tile(rng.dirichlet(np.ones(6)), (200, 1)).astype(dtype)
    rounded = exact * (1 + 4 * np.finfo(dtype).eps * rng.uniform(-1, 1, exact.shape)).astype(dtype)
    y, groups = rng.choice(6, 200, p=exact[0] / exact[0].sum(dtype=float)) + 0.5, np.ones(200)
    kinds = [
        (cm.SplitConformal, (), ()), (cm.MondrianConformal, (groups,), (groups,)),
        (cm.ConditionalConformal, (groups,), (groups,)),
    ]  # fmt: skip
    for kind, calibrated, asked in kinds:
        sets = []
        for proba in (exact, rounded):
            cal = kind(bins, 0.3, score, joint).set_scale(0.3, 0.1).calibrate(proba, y, *calibrated)
            for new in (exact, rounded):
                sets.append(cal.predict(new, *asked).masks[0])
        for mask in sets[1:]:
            np.testing.assert_array_equal(mask, sets[0])


class Powers:
    name = "powers"

    def of_bins(self, proba, widths):
        return np.broadcast_to(self.factor * np.arange(1.0, 7), proba.shape)


@pytest.mark.parametrize("factor", [1e-322, 1e-310, 1, 1e300, 2.9e307])
def test_scores_of_any_size_keep_their_sets(factor):
    score, bins = Powers(), cm.QuantileBins.from_edges([np.arange(7.0)])
    score.factor = factor
    y = np.arange(60) % 6 + 0.5
    sets = cm.SplitConformal(bins, "0.3", score).calibrate(np.full((60, 6), 1 / 6), y).predict(np.full((1, 6), 1 / 6))
    assert sets.masks[0].tolist() == [[True] * 5 + [False]]


def test_missing_group_coverage_follows_its_exact_law():
    """That of the largest of the groups' thresholds."""
    # scores of the first of two bins are uniform, so the thresholds of two groups are order statistics
    bins, sizes, alpha = cm.QuantileBins.from_edges([[0.0, 1.0, 2.0]]), (19, 35), 0.1
    laws = [stats.beta(cm.conformal_rank(n, alpha), n + 1 - cm.conformal_rank(n, alpha)) for n in sizes]
    expected = 1 - quad(lambda u: laws[0].cdf(u) * laws[1].cdf(u), 0, 1)[0]
    rng, groups, held = np.random.default_rng(0), np.repeat(["a", "b"], sizes), []
    for _ in range(400):
        score = rng.random(sum(sizes) + 100)
        proba = np.column_stack([1 - score, score])
        cal = cm.MondrianConformal(bins, alpha).calibrate(proba[: sum(sizes)], np.full(sum(sizes), 0.5), groups)
        held.append(cal.predict(proba[sum(sizes) :], [None] * 100).masks[0][:, 0].mean())
    assert abs(np.mean(held) - expected) < 4 * np.std(held) / 20
    assert expected > max(cm.conformal_rank(n, alpha) / (n + 1) for n in sizes)


@pytest.mark.parametrize(
    ("groups", "gaps", "kind"),
    [
        (["a", None, "b", "new"], [1], "text"), (np.array(["a", np.nan, "b", "new"], dtype=object), [1], "text"),
        (np.array([1.0, np.nan, 2.0, 7.0]), [1], "number"), ([1, None, 2, 7], [1], "number"),
        (np.array(["2024-01-01", "NaT", "2024-01-02", "2025-01-01"], "M8[D]"), [1], "date"),
    ],
)  # fmt: skip
def test_missing_group_gets_the_largest_threshold(groups, gaps, kind):
    labels = {"text": ["a", "b"], "number": [1, 2], "date": np.array(["2024-01-01", "2024-01-02"], "M8[D]")}[kind]
    rng, bins = np.random.default_rng(0), cm.QuantileBins.from_edges([np.arange(9.0)])
    proba = rng.dirichlet(np.full(8, 0.5), 90)
    cal = cm.MondrianConformal(bins, 0.2).calibrate(proba[:60], rng.uniform(0, 8, 60), np.repeat(labels, 30))
    asked = proba[60:64]
    each = [cal.predict(asked, np.repeat(labels[k : k + 1], 4)).masks[0] for k in range(2)]
    regions = cal.predict(asked, groups)
    np.testing.assert_array_equal(regions.masks[0][gaps], (each[0] | each[1])[gaps])
    np.testing.assert_array_equal(regions.masks[0][[0, 2]], [each[0][0], each[1][2]])
    assert regions.unbounded[:, 0].tolist() == [False, False, False, True]
