import numpy as np
import pytest
from scipy.stats import norm
from sklearn.datasets import make_friedman1
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern

from conformodal.conformal import ConformalRegressor, QuickDensity
from conformodal.conformal.density import named
from conformodal.conformal.density.forest import LeafForest, group_values, rank_cosines
from conformodal.conformal.density.mixture import places_on, shifted_masses
from conformodal.conformal.density.named import SubsetProcess, boosting, fit_out_of_fold, folds_of, smooth_member

EDGES = np.linspace(-3, 3, 61)


def two_branches(n, seed):
    """Two branches of equal probability and known spread: the density is known."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 2))
    return X, rng.choice([-1, 1], n) * (1 + 0.5 * X[:, 0]) + 0.2 * rng.standard_normal(n)


def true_masses(X, edges):
    below = sum(norm.cdf((edges - side * (1 + 0.5 * X[:, :1])) / 0.2) for side in (-1, 1)) / 2
    below[:, 0], below[:, -1] = 0, 1
    return np.diff(below, axis=1)


@pytest.fixture(scope="module")
def fitted():
    return QuickDensity(random_state=0).fit_bins(*two_branches(1000, 0), EDGES)


def test_it_finds_a_known_density_of_two_modes(fitted):
    X, _ = two_branches(500, 1)
    found, truth = fitted.predict_proba(X), true_masses(X, EDGES)
    apart = 0.5 * np.abs(found - truth).sum(axis=1).mean()
    marginal = 0.5 * np.abs(truth.mean(axis=0) - truth).sum(axis=1).mean()
    assert apart < 0.2 < marginal
    middle = np.abs((EDGES[1:] + EDGES[:-1]) / 2) < 0.2
    assert found[:, middle].sum(axis=1).mean() < 0.05


def test_it_integrates_to_one_wherever_it_is_asked(fitted):
    X, _ = two_branches(300, 2)
    for asked in (X, 1e6 * X, X[:1], X[:0]):
        found = fitted.predict_proba(asked)
        assert found.shape == (len(asked), 60)
        assert (found > 0).any(axis=1).all()
        assert (found >= 0).all()
        np.testing.assert_allclose(found.sum(axis=1), 1)


def test_left_out_densities_are_as_likely_as_those_of_new_rows():
    rng = np.random.default_rng(0)
    X, y = rng.uniform(-1, 1, (2150, 3)), rng.standard_t(3, 2150).clip(-3, 3)
    density = QuickDensity(random_state=0).fit_bins(X[:150], y[:150], EDGES)
    proba, codes = density.left_out_
    old = np.log(proba[np.arange(codes.size), codes])
    new = density.predict_proba(X[150:])
    new = np.log(new[np.arange(2000), np.searchsorted(EDGES, y[150:]) - 1])
    assert old.mean() < new.mean() + 2 * old.std() / np.sqrt(old.size)


@pytest.mark.slow
def test_sample_weights_are_relative_and_zero_drops_rows():
    X, y = two_branches(120, 5)
    weight = np.random.default_rng(0).integers(0, 3, 120).astype(float)
    kept = weight > 0
    one = QuickDensity(random_state=0).fit_bins(X, y, EDGES, weight).predict_proba(X)
    other = QuickDensity(random_state=0).fit_bins(X[kept], y[kept], EDGES, 7 * weight[kept]).predict_proba(X)
    np.testing.assert_allclose(one, other, atol=1e-9)
    plain = QuickDensity(random_state=0).fit_bins(X, y, EDGES).predict_proba(X)
    same = QuickDensity(random_state=0).fit_bins(X, y, EDGES, np.full(120, 3.0)).predict_proba(X)
    np.testing.assert_array_equal(plain, same)


@pytest.mark.parametrize("n", [2, 7])
def test_few_rows_and_constant_columns(n):
    X, y = np.ones((n, 1)), np.arange(n, dtype=float)
    for values in (y, 0 * y):
        proba = QuickDensity(random_state=0).fit_bins(X, values, EDGES).predict_proba(X)
        np.testing.assert_allclose(proba.sum(axis=1), 1)


def test_column_screening_uses_training_rows_only():
    rng = np.random.default_rng(0)
    X, y = rng.normal(size=(60, 2000)), rng.normal(size=60)
    fits = (boosting(0.1, 20, 8, 5, 60, 0), X, y, np.ones(60), folds_of(60, 0, 5))
    assert abs(np.corrcoef(fit_out_of_fold(*fits)[0], y)[0, 1]) < 0.3  # 0.5 where left-out rows choose columns, too
    X[:, 7] = y
    predicted, model = fit_out_of_fold(*fits)
    assert np.corrcoef(predicted, y)[0, 1] > 0.7
    assert len(model.columns) == 128


def grown(weight):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (300, 2))
    y = X[:, 0] + 0.1 * rng.standard_normal(300)
    groups, at = group_values(y)
    forest = LeafForest(ExtraTreesRegressor, 20, 5, 0)
    rows = np.arange(0, 300, 3)
    return forest.fit(X, rank_cosines(y, 4), y, weight, [(groups, at)], rows), X, y, groups, rows


def test_weights_are_those_of_the_leaves_one_by_one():
    weight = np.random.default_rng(1).uniform(0.5, 2, 300)
    forest, X, _, groups, _ = grown(weight)
    asked = X[:10] * 0.9
    leaves = [tree.apply(asked.astype(np.float32)) for tree in forest.forest.estimators_]
    known = [tree.apply(X.astype(np.float32)) for tree in forest.forest.estimators_]
    expected = np.zeros((10, groups.max() + 1))
    for to, of, drawn in zip(leaves, known, forest.forest.estimators_samples_, strict=True):
        count = np.bincount(drawn, minlength=300) * weight
        for i, leaf in enumerate(to):
            share = np.bincount(groups, count * (of == leaf), minlength=expected.shape[1])
            expected[i] += share / share.sum() / len(known)
    weights = forest.projection([np.eye(expected.shape[1])])(forest.apply(asked))
    np.testing.assert_allclose(weights, expected, atol=1e-7)


def test_rows_are_predicted_independently(fitted):
    X = np.random.default_rng(5).uniform(-1, 1, (9000, 2))  # more than a block
    whole = fitted.predict_proba(X)
    np.testing.assert_allclose(whole[::-1], fitted.predict_proba(X[::-1]), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(whole[7:8], fitted.predict_proba(X[7:8]), rtol=1e-12, atol=1e-12)


def test_masses_match_kernels_weighted_by_leaves(fitted):
    X = np.random.default_rng(6).uniform(-1, 1, (50, 2))
    guided, direct = fitted.forests_
    leaves = direct.apply(X)
    summary = fitted.location_.predict(X, direct.means(leaves))
    extended = np.column_stack((X, summary))
    groups = [np.eye(len(kernel)) for kernel in fitted._kernels[2:]]
    residuals, values = np.split(guided.projection(groups[:2])(guided.apply(extended)), [len(groups[0])], axis=1)
    of = [*fitted._pooled, residuals, values, direct.projection(groups[2:])(leaves)]
    expected = np.zeros((50, fitted.edges_.size - 1))
    spread = np.exp(fitted.spread_.predict(extended))
    for j, (weight, masses) in enumerate(zip(fitted.weights_, map(np.matmul, of, fitted._kernels), strict=True)):
        if j in (1, 2):
            below = np.pad(np.cumsum(np.broadcast_to(masses, (50, masses.shape[1])), axis=1), ((0, 0), (1, 0)))
            expected += weight * shifted_masses(below, fitted._grid, summary[:, 0], spread, fitted._z_edges)
        else:
            expected += weight * masses
    np.testing.assert_allclose(fitted.predict_proba(X), expected, atol=1e-5)
    assert fitted._mixed_masses().projections[1](leaves).shape[1] < len(fitted._kernels[4])


@pytest.mark.parametrize("clumped", [False, True])
def test_places_on_a_grid_are_those_of_a_search(clumped):
    rng = np.random.default_rng(0)
    for _ in range(50):
        size = 10.0 ** rng.integers(-6, 7)
        grid = np.unique(rng.standard_cauchy(rng.integers(2, 400)) * size + 1e4 * clumped)
        near = np.sort(np.append(rng.choice(grid, 300) + rng.standard_cauchy(300) * size, [0.0, -1e200, 1e200]))
        places, cells, middle = places_on(grid, near[None])[0], np.arange(grid.size), np.median(np.abs(grid))
        assert (np.diff(places) >= -1e-9).all()
        found, exact = (
            x / (middle + np.abs(x)) for x in (np.interp(places, cells, grid), np.clip(near, grid[0], grid[-1]))
        )
        np.testing.assert_allclose(found, exact, atol=2 / 4096)  # a step of the table


def test_out_of_bag_rows_sum_to_one_and_follow_the_values():
    forest, _, y, groups, rows = grown(np.ones(300))
    (found,) = forest.out_of_bag_
    assert found.shape == (100, groups.max() + 1)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    assert np.corrcoef(forest.out_of_bag_mean_, y)[0, 1] > 0.9
    at = np.array([y[groups == g].mean() for g in range(found.shape[1])])
    np.testing.assert_allclose(found @ at, forest.out_of_bag_mean_[rows], atol=0.05)


def sets_of(X, y, monkeypatch, smooth):
    with monkeypatch.context() as patched:
        if not smooth:
            patched.setattr(named, "smooth_member", lambda *args: None)
        reg = ConformalRegressor(calibration_size=0.4, random_state=0).fit(X[:1000], y[:1000])
    regions = reg.predict_region(X[1000:])
    return reg.estimators_[0].location_, regions, regions.contains(y[1000:]).mean()


def test_a_smooth_target_has_shorter_sets_by_the_smooth_member(monkeypatch):
    X, y = make_friedman1(1600, noise=1.0, random_state=0)
    location, regions, held = sets_of(X, y, monkeypatch, True)
    without, longer, _ = sets_of(X, y, monkeypatch, False)
    assert location.weights_[0] > 0.5
    assert location.weights_.size == without.weights_.size + 1
    assert regions.length.mean() < 0.85 * longer.length.mean()
    assert abs(held - 0.9) < 0.05


def test_a_smooth_member_that_does_not_help_changes_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    X = rng.integers(0, 40, (1600, 2)).astype(float)
    y = rng.normal(size=(40, 40))[tuple(X.astype(int).T)] + 3 * (X[:, 0] % 2) + 0.1 * rng.normal(size=1600)
    location, regions, _ = sets_of(X, y, monkeypatch, True)
    without, same, _ = sets_of(X, y, monkeypatch, False)
    assert location.weights_.size == without.weights_.size
    np.testing.assert_array_equal(regions.masks[0], same.masks[0])


def test_whole_weights_of_the_smooth_member_equal_repetitions():
    rng = np.random.default_rng(0)
    X, weight = rng.normal(size=(60, 3)), rng.integers(1, 4, 60)
    y = np.sin(X[:, 0]) + 0.3 * rng.normal(size=60)
    at, times = rng.normal(size=(20, 3)), np.repeat(np.arange(60), weight)
    kernel = ConstantKernel(1.5) * Matern([1.0, 2.0, 3.0], nu=1.5)
    one = SubsetProcess(kernel, 0.2, 0).fit(X, y, weight.astype(float))
    np.testing.assert_allclose(
        one.predict(at), SubsetProcess(kernel, 0.2, 0).fit(X[times], y[times]).predict(at), atol=1e-6
    )


@pytest.mark.parametrize("n", [1, 255, 600])
def test_the_process_predicts_as_that_of_scikit_learn(n):
    X, y = two_branches(300, 4)
    process = SubsetProcess(ConstantKernel(2.0) * Matern([0.5, 3.0], nu=1.5), 1e-4, 0).fit(X, y)
    at = np.concatenate((X, two_branches(300, 5)[0]))[-n:]
    scaled = np.clip((at - process.center_) / process.spread_, -6, 6)
    np.testing.assert_allclose(process.predict(at), process.process_.predict(scaled) + process.mean_, atol=1e-9)
    np.testing.assert_array_equal(process.predict(at[:1]), process.predict(at)[:1])


@pytest.mark.parametrize("n_columns", [1, 45])
def test_the_search_for_a_kernel_does_not_end_where_all_is_noise(n_columns):
    rng = np.random.default_rng(0)
    X = rng.normal(size=(300, n_columns))
    y = X[:, 0] + 0.5 * rng.normal(size=300)
    guess = fit_out_of_fold(smooth_member(X, y, 0), X, y, np.ones(300), folds_of(300, 0, 5))[0]
    assert 1 - np.mean((y - guess) ** 2) / y.var() > (0.75 if n_columns == 1 else 0.5)
