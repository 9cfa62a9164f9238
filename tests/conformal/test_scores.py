import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from conformodal.conformal import Aps, QuantileBins, SplitConformal
from conformodal.conformal.scores import SCORES, row_uniforms


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(sorted(SCORES)), st.sampled_from(["none", "bonferroni", "max"]))
def test_sets_nest_in_alpha_and_ignore_the_order_of_calibration(problem, seed, score, joint):
    bins, proba, y = problem(seed)

    def calibrated(rows):
        return SplitConformal(bins, 0.3, score, joint).fit_scale(proba[50:], y[50:]).calibrate(proba[rows], y[rows])

    one = calibrated(np.arange(50))
    other = calibrated(np.random.default_rng(seed).permutation(50))
    tight, loose, same = one.predict(proba), one.at(0.1).predict(proba), other.predict(proba)
    for a, b, c in zip(tight.masks, loose.masks, same.masks, strict=True):
        assert not (a & ~b).any()
        np.testing.assert_array_equal(a, c)


def test_aps_adds_a_random_share_of_its_own_bin():
    proba = np.array([[0.5, 0.3, 0.2]])
    plain = Aps(share=1).of_bins(proba, np.ones(3))
    np.testing.assert_allclose(plain, [[0.5, 0.8, 1.0]])
    u = row_uniforms(proba)[0]
    np.testing.assert_allclose(Aps().of_bins(proba, np.ones(3)), [[0.5 * u, 0.5 + 0.3 * u, 0.8 + 0.2 * u]])
    by_density = Aps("density", share=1).of_bins(proba, np.array([5.0, 1.0, 1.0]))
    np.testing.assert_allclose(by_density, [[1.0, 0.3, 0.5]])


def test_the_random_shares_are_uniform_and_belong_to_the_row():
    rows = np.random.default_rng(0).dirichlet(np.ones(5), 20_000)
    u = row_uniforms(rows)
    counts = np.histogram(u, 20, (0, 1))[0]
    assert np.abs(counts - 1000).max() < 5 * np.sqrt(1000)
    np.testing.assert_array_equal(row_uniforms(rows[::-1]), u[::-1])
    assert abs(np.corrcoef(u, rows[:, 0])[0, 1]) < 0.03


@settings(deadline=None, max_examples=200)
@given(
    seed=st.integers(0, 10**6),
    peak=st.sampled_from([1, 8, 60, 300]),
    limit=st.sampled_from([-np.inf, 0.0, 0.3, 0.5, 0.9, 0.99, 0.9995, 1.0, np.inf]),
    order=st.sampled_from(["probability", "density"]),
    share=st.sampled_from([None, 0.5, 1.0]),
)
def test_level_set_holds_bins_scored_within_the_limit(seed, peak, limit, order, share):
    rng = np.random.default_rng(seed)
    proba, widths = rng.random(200) ** peak, rng.random(200) + 0.1
    proba[rng.random(200) < 0.2] = 0
    proba[rng.integers(200, size=20)] = proba[rng.integers(200)]  # ties
    proba = proba / proba.sum() if proba.any() else np.full(200, 0.005)
    score = Aps(order, share)
    # the bins of three targets; no limit is one of the scores, whose sums round
    starts, limits = np.array([0, 1, 90]), np.array([limit, 0.6, limit]) + 1.2345e-6
    for part in np.split(proba, starts[1:]):
        part[...] = part / part.sum() if part.any() else 1 / len(part)
    parts = zip(np.split(proba, starts[1:]), np.split(widths, starts[1:]), limits, strict=True)
    expected = [score.of_bins(part[None], wide)[0] <= level for part, wide, level in parts]
    np.testing.assert_array_equal(score.level_set(proba, widths, limits, starts), np.concatenate(expected))


def test_single_precision_loses_no_bin_at_the_threshold():
    rng, bins = np.random.default_rng(0), QuantileBins.from_edges([np.arange(3001)])
    proba = rng.random((60, 3000)) ** 8
    proba = (proba / proba.sum(axis=1, keepdims=True)).astype(np.float32)
    y = rng.integers(3000, size=60) + 0.5
    rule = SplitConformal(bins, 0.1, "hpd").calibrate(proba, y)
    for i, score in enumerate(rule.scores_[:, 0]):
        limit = rule.per_target(np.array([score]))
        assert rule.regions_at(proba[[i]], limit).contains(y[[i]])[0, 0]


def test_regions_do_not_depend_on_other_samples():
    rng = np.random.default_rng(3)
    bins = QuantileBins(60).fit(rng.standard_normal((500, 2)))
    proba = [p / p.sum(axis=1, keepdims=True) for p in (rng.random((40, 60)) ** 40 for _ in range(2))]
    for score in ("hpd", "aps", "density"):
        rule = SplitConformal(bins, 0.1, score)
        thresholds = np.quantile(rule.score_samples(proba, rng.standard_normal((40, 2))), [0.5, 0.9], axis=0)
        for limits in thresholds:
            together = rule.regions_at(proba, limits)
            for i in range(40):
                alone = rule.regions_at([p[[i]] for p in proba], limits)
                for mask, every in zip(alone.masks, together.masks, strict=True):
                    np.testing.assert_array_equal(mask[0], every[i])
