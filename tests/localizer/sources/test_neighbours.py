import numpy as np
import pytest
from sklearn.linear_model import Ridge

from conformodal.features.head import Projection
from conformodal.localizer.sources.neighbours import LocalRegression, LocalSettings, fit_local


def regression(x, y, settings):
    k = x.shape[1]
    through = Projection(np.zeros(k, np.float32), np.eye(k, dtype=np.float32))
    return LocalRegression(through, x.astype(np.float32), y, np.ones(y.shape[1]), settings)


def best(answers):
    return answers.values[np.arange(len(answers.values)), answers.weights.argmax(axis=1)]


def poses(places):
    """Targets (n, 7) at places (n,) along x, with one orientation."""
    return np.column_stack((places, np.zeros((len(places), 2)), np.tile([1.0, 0, 0, 0], (len(places), 1))))


def test_it_is_a_weighted_ridge_regression_on_the_nearest():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(80, 5)).astype(np.float32), rng.normal(size=(80, 2))
    query, n, ridge = rng.normal(size=5).astype(np.float32), 15, 0.2
    square = ((x[:, :3].astype(float) - query[:3]) ** 2).sum(axis=1)
    near = np.argsort(square)[:n]
    weights = np.exp(-2 * square[near] / square[near].max())
    weights /= weights.sum()
    at = x[near, :3].astype(float)
    centred = at - weights @ at
    penalty = ridge * (weights[:, None] * centred**2).sum() / n
    oracle = Ridge(alpha=penalty).fit(at, y[near], sample_weight=weights)
    answers = regression(x, y, LocalSettings(3, n, ridge, None)).predict(query[None])
    np.testing.assert_allclose(best(answers)[0], oracle.predict(query[None, :3].astype(float))[0], rtol=1e-6)


def two_places(n=60):
    """Samples that look alike at two places, 10 apart: the features tell where in a place, not which."""
    rng = np.random.default_rng(2)
    inside, place = rng.uniform(-1, 1, size=n), np.arange(n) % 2
    x = np.column_stack((inside, 0.01 * rng.normal(size=n)))
    return x.astype(np.float32), (inside + 10 * place)[:, None], place


QUERY = np.array([[0.3, 0.0]], dtype=np.float32)


def test_lookalike_places_get_separate_answers():
    x, y, _ = two_places()
    apart = regression(x, y, LocalSettings(2, 10, 1e-6, 3.0)).predict(QUERY)
    np.testing.assert_allclose(sorted(apart.values[0, apart.weights[0] > 0, 0]), [0.3, 10.3], atol=0.02)
    np.testing.assert_allclose(apart.weights.sum(axis=1), 1)
    together = regression(x, y, LocalSettings(2, 10, 1e-6, None)).predict(QUERY)
    assert 2 < best(together)[0, 0] < 8


@pytest.mark.parametrize("radius", [None, 3.0])
def test_hidden_references_do_not_answer(radius):
    x, y, place = two_places()
    spoilt = np.where(place[:, None] == 1, 1e9, y)
    answers = regression(x, spoilt, LocalSettings(2, 10, 1e-6, radius)).predict(QUERY, (place == 1)[None])
    np.testing.assert_allclose(best(answers), [[0.3]], atol=0.02)


def test_settings_that_separate_lookalikes_are_chosen():
    x, y, _ = two_places(300)
    choices = [LocalSettings(2, 10, 0.03, radius) for radius in (None, 0.5)]
    left_out = fit_local(x, poses(y[:, 0]), np.arange(300), choices=choices)
    assert left_out.regression.settings.radius == 0.5
    assert np.abs(left_out.answers.values[:, :, :1] - y[left_out.rows][:, None]).min(axis=1).max() < 0.2


def test_a_group_that_is_left_out_sees_nothing_of_itself():
    """Copies of one sample in one group would answer for each other."""
    rng = np.random.default_rng(5)
    x, y = np.repeat(rng.normal(size=(40, 3)), 5, axis=0).astype(np.float32), poses(np.repeat(rng.normal(size=40), 5))
    choices = [LocalSettings(3, 5, 0.03, None)]
    apart = fit_local(x, y, np.repeat(np.arange(40), 5), choices=choices)
    single = fit_local(x, y, np.arange(200), choices=choices)
    assert np.abs(best(single.answers) - y[single.rows]).max() < 1e-3
    assert np.abs(best(apart.answers) - y[apart.rows])[:, 0].mean() > 1e-3


def test_the_view_that_knows_is_chosen():
    rng = np.random.default_rng(0)
    x, places = rng.normal(size=(200, 9)).astype(np.float32), rng.normal(size=200)
    x[:, 4:6] = places[:, None]
    views = [slice(0, 4), slice(4, 6), slice(6, 9)]
    left_out = fit_local(x, poses(places), np.arange(200), choices=[LocalSettings(2, 12, 0.01, None)], views=views)
    assert np.flatnonzero(left_out.regression.projection.components.any(axis=1)).tolist() == [4, 5]
