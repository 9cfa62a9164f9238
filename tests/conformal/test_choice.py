import numpy as np
import pytest
from scipy.stats import norm
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import ConformalRegressor, Density, Interval, QuantileBins, ScaledDensity
from conformodal.conformal.choice import choose_score
from conformodal.conformal.scores import relative_entropy

EDGES = np.linspace(-12, 12, 241)
WIDTHS = np.diff(EDGES)


def rows(seed, modes=(0.0,), n=2000):
    """Left-out rows of Gaussian modes whose spread differs, and their densities."""
    rng = np.random.default_rng(seed)
    spread = rng.uniform(0.1, 1.0, n)
    y = rng.choice(modes, n) + spread * rng.standard_normal(n)
    below = sum(norm.cdf((EDGES - mode) / spread[:, None]) for mode in modes) / len(modes)
    proba = np.diff(below, axis=1)
    return proba / proba.sum(axis=1, keepdims=True), np.searchsorted(EDGES, y) - 1


def sizes(score, left_out, alpha=0.1):
    proba, codes = left_out
    scores = score.of_bins(proba, WIDTHS)
    own = scores[np.arange(codes.size), codes]
    return ((scores <= np.quantile(own, 1 - alpha)) @ WIDTHS).mean()


def covered(score, left_out, alpha=0.1):
    """Coverage of the quarter of rows with the widest distributions."""
    proba, codes = left_out
    entropy = relative_entropy(proba, WIDTHS)
    own = score.of_bins(proba, WIDTHS)[np.arange(codes.size), codes]
    return (own <= np.quantile(own, 1 - alpha, method="inverted_cdf"))[entropy >= np.quantile(entropy, 0.75)].mean()


@pytest.mark.parametrize("seed", range(5))
def test_sets_are_never_longer_than_one_interval(seed):
    bell, pair = rows(seed), rows(seed, modes=(-4.0, 4.0))
    for of in (bell, pair):
        assert sizes(choose_score([of], [WIDTHS], 0.1), of) <= 1.0101 * sizes(Interval(), of)
    assert not isinstance(choose_score([pair], [WIDTHS], 0.1), Interval)


@pytest.mark.parametrize("modes", [(0.0,), (-4.0, 4.0)])
def test_wide_distributions_are_covered_like_others(modes):
    score, new = choose_score([rows(0, modes=modes)], [WIDTHS], 0.1), rows(1, modes=modes)
    assert covered(Density(), new) < 0.83
    assert covered(score, new) > 0.88


def test_interval_score_needs_even_coverage():
    """It is not chosen where it covers wide distributions less often."""
    rng = np.random.default_rng(0)
    centers, wide = (EDGES[1:] + EDGES[:-1]) / 2, rng.random(4000) < 0.25
    spread = rng.uniform(0.05, 0.1, (4000, 1))  # narrow distributions have a little far mass, which their spread counts
    far = norm.pdf(centers, -0.6, spread) + norm.pdf(centers, 0.6, spread)
    proba = np.where(
        wide[:, None], norm.pdf(centers, 0, 20 * spread), 0.95 * norm.pdf(centers, 0, spread) + 0.025 * far
    )
    proba /= proba.sum(axis=1, keepdims=True)
    codes = np.minimum((np.cumsum(proba, axis=1) < rng.random((4000, 1))).sum(axis=1), centers.size - 1)
    assert covered(Interval(), (proba, codes)) < 0.85
    score = choose_score([(proba, codes)], [WIDTHS], 0.1)
    assert isinstance(score, ScaledDensity)
    assert sizes(Interval(), (proba, codes)) < sizes(score, (proba, codes))
    assert covered(score, (proba, codes)) > 0.89


def test_of_few_rows_nothing_is_concluded():
    assert isinstance(choose_score([rows(0, n=99)], [WIDTHS], 0.1), Density)
    assert not isinstance(choose_score([rows(0, n=99)], [WIDTHS], 0.1), ScaledDensity)


def test_several_targets_share_a_score():
    bell, pair = rows(0), rows(0, modes=(-4.0, 4.0))
    assert not isinstance(choose_score([bell, pair], [WIDTHS, WIDTHS], 0.1), Interval)


def test_the_regressor_uses_what_was_chosen_and_keeps_no_rows(tmp_path):
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 1, (200, 1))
    y = (0.05 + X[:, 0]) * rng.standard_normal(200)
    reg = ConformalRegressor(random_state=0).fit(X, y)
    assert isinstance(reg.calibrator_.score, (ScaledDensity, Interval))
    assert not hasattr(reg.estimators_[0], "left_out_")
    pytest.importorskip("skops")
    reg.save(tmp_path / "reg.skops")
    other = ConformalRegressor.load(tmp_path / "reg.skops")
    for mask, same in zip(reg.predict_region(X).masks, other.predict_region(X).masks, strict=True):
        np.testing.assert_array_equal(mask, same)
    fixed = ConformalRegressor(DecisionTreeClassifier(max_depth=2), conformity_score="density").fit(X, y)
    assert fixed.calibrator_.score == "density"


def test_scaled_density_ignores_the_unit_of_the_target():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 2, 9))])
    proba = rng.dirichlet(np.ones(8), 20)
    for power in (0, 0.5, 1.5):
        for unit in (1e-200, 1e200):
            plain = ScaledDensity(power).of_bins(proba, bins.widths[0])
            other = ScaledDensity(power).of_bins(proba, unit * bins.widths[0])
            np.testing.assert_allclose(other * unit, plain)
    np.testing.assert_allclose(
        ScaledDensity(0).of_bins(proba, bins.widths[0]), Density().of_bins(proba, bins.widths[0])
    )
    np.testing.assert_allclose(
        Interval().of_bins(proba, 1e200 * bins.widths[0]), Interval().of_bins(proba, bins.widths[0])
    )


def test_sets_of_the_interval_score_are_intervals():
    rng = np.random.default_rng(0)
    proba, widths = rng.dirichlet(np.full(30, 0.2), 200), rng.uniform(0.1, 3, 30)
    scores = Interval().of_bins(proba, widths)
    for threshold in (0.3, 1.0, 2.0):
        steps = np.diff(np.pad(scores <= threshold, ((0, 0), (1, 1))).astype(int), axis=1)
        assert ((steps == 1).sum(axis=1) <= 1).all()
