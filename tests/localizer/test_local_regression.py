from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import Ridge

from conformodal.features.projection import Projection
from conformodal.localizer.errors import LocalizationError
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.settings import NEIGHBOURS
from conformodal.localizer.sources.neighbours import tuning
from conformodal.localizer.sources.neighbours.regression import LocalAnswers, LocalRegression, LocalSettings
from conformodal.localizer.sources.neighbours.source import NeighbourSource
from conformodal.localizer.sources.neighbours.tuning import LOCAL_CHOICES, fit_local
from tests.localizer.conftest import poses_of


def regression(x, y, settings, scale=None):
    k = x.shape[1]
    through = Projection(np.zeros(k, np.float32), np.eye(k, dtype=np.float32))
    scale = np.ones(y.shape[1]) if scale is None else scale
    return LocalRegression(through, x.astype(np.float32), y, scale, settings)


def test_a_linear_world_is_answered_exactly():
    rng = np.random.default_rng(0)
    x, slope = rng.normal(size=(200, 4)), rng.normal(size=(4, 3))
    queries = rng.normal(size=(50, 4)).astype(np.float32)
    found = regression(x, x.astype(np.float32) @ slope, LocalSettings(4, 12, 1e-9, None)).predict(queries)
    np.testing.assert_allclose(found.best, queries @ slope, atol=1e-5)
    np.testing.assert_array_equal(found.weights, np.ones((50, 1)))


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
    found = regression(x, y, LocalSettings(3, n, ridge, None)).predict(query[None])
    np.testing.assert_allclose(found.best[0], oracle.predict(query[None, :3].astype(float))[0], rtol=1e-6)


def two_places(n=60):
    """Samples that look alike at two places, 10 apart: the features tell where in a place, not which."""
    rng = np.random.default_rng(2)
    inside, place = rng.uniform(-1, 1, size=n), np.arange(n) % 2
    x = np.column_stack((inside, 0.01 * rng.normal(size=n)))
    return x, (inside + 10 * place)[:, None], place


def test_places_that_look_alike_get_an_answer_each_and_none_in_between():
    x, y, _ = two_places()
    query = np.array([[0.3, 0.0]], dtype=np.float32)
    apart = regression(x, y, LocalSettings(2, 10, 1e-6, 3.0)).predict(query)
    there = apart.weights[0] > 0
    np.testing.assert_allclose(sorted(apart.values[0, there, 0]), [0.3, 10.3], atol=0.02)
    np.testing.assert_allclose(apart.weights.sum(axis=1), 1)
    together = regression(x, y, LocalSettings(2, 10, 1e-6, None)).predict(query)
    assert 2 < together.best[0, 0] < 8


def test_references_of_a_querys_own_group_are_not_looked_at():
    x, y, place = two_places()
    spoilt = y.copy()
    spoilt[place == 1] = 1e9
    for radius in (None, 3.0):
        found = regression(x, spoilt, LocalSettings(2, 10, 1e-6, radius)).predict_projected(
            np.array([[0.3, 0.0]], dtype=np.float32), (np.array([1]), place)
        )
        np.testing.assert_allclose(found.best, [[0.3]], atol=0.02)


def test_many_queries_are_answered_as_single_ones():
    rng = np.random.default_rng(3)
    model = regression(rng.normal(size=(90, 6)), rng.normal(size=(90, 2)), LocalSettings(6, 8, 0.1, 1.0))
    queries = rng.normal(size=(600, 6)).astype(np.float32)
    whole = model.predict(queries)
    for i in (0, 255, 256, 599):
        alone = model.predict(queries[i : i + 1])
        np.testing.assert_allclose(alone.values[0], whole.values[i], rtol=1e-9)
        np.testing.assert_allclose(alone.novelty[0], whole.novelty[i], rtol=1e-9)
    assert model.predict(queries[:0]).values.shape[0] == 0


def test_novelty_is_the_distance_to_what_neighbours_span():
    rng = np.random.default_rng(4)
    x = np.column_stack((rng.normal(size=(100, 2)), np.zeros(100)))
    model = regression(x, x[:, :1], LocalSettings(3, 10, 1e-9, None))
    found = model.predict(np.array([[0.1, 0.2, 0.0], [0.1, 0.2, 0.7]], dtype=np.float32))
    np.testing.assert_allclose(found.novelty, [0, 0.7], atol=1e-3)


@pytest.mark.parametrize("shape", [(59, 1), (60, 2)])
def test_shapes_are_checked(shape):
    x, _, _ = two_places()
    with pytest.raises(LocalizationError, match=r"must be \(n, k\)"):
        regression(x, np.zeros(shape), LOCAL_CHOICES[0], np.ones(1))


def test_a_world_of_copies_is_told_apart_when_settings_are_chosen():
    x, y, _ = two_places(300)
    choices = [LocalSettings(2, 10, 0.03, radius) for radius in (None, 0.5)]
    chosen, left_out = fit_local(x.astype(np.float32), y, y.std(axis=0), np.arange(300), choices=choices)
    assert chosen.settings.radius == 0.5
    assert np.abs(left_out.answers.values - y[left_out.rows][:, None]).min(axis=1).max() < 0.2


def test_a_group_that_is_left_out_sees_nothing_of_itself():
    """Copies of one sample in one group would answer for each other."""
    rng = np.random.default_rng(5)
    x, y = np.repeat(rng.normal(size=(40, 3)), 5, axis=0).astype(np.float32), np.repeat(rng.normal(size=(40, 1)), 5, 0)
    choices = [LocalSettings(3, 5, 0.03, None)]
    _, apart = fit_local(x, y, np.ones(1), np.repeat(np.arange(40), 5), choices=choices)
    _, single = fit_local(x, y, np.ones(1), np.arange(200), choices=choices)
    assert np.abs(single.answers.best - y[single.rows]).max() < 1e-3 < np.abs(apart.answers.best - y[apart.rows]).mean()


def test_the_view_that_knows_is_chosen():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(200, 9)).astype(np.float32), rng.normal(size=(200, 2))
    x[:, 4:6] = y
    settings = [LocalSettings(2, 12, 0.01, None)]
    views = [slice(0, 4), slice(4, 6), slice(6, 9)]
    found, left_out = fit_local(x, y, np.ones(2), np.arange(200), choices=settings, views=views)
    assert np.flatnonzero(found.projection.components.any(axis=1)).tolist() == [4, 5]
    assert np.abs(left_out.answers.best - y[left_out.rows]).max() < 0.2
    np.testing.assert_allclose(found.predict(x).best, y, atol=0.2)
    x[:, 6:] = 1.0  # a view that says nothing is passed over
    again, _ = fit_local(x, y, np.ones(2), np.arange(200), choices=settings, views=views)
    np.testing.assert_array_equal(again.predict(x).best, found.predict(x).best)


def test_settings_that_some_samples_speak_for_are_compared_on_all(monkeypatch):
    rng = np.random.default_rng(6)
    x = rng.normal(size=(600, 4)).astype(np.float32)
    y = np.sin(2 * x[:, :1]) + 0.1 * rng.normal(size=(600, 1))
    choices = [LocalSettings(k, n, 0.03, None) for k in (1, 4) for n in (5, 10, 40)]

    def fitted(screened, finalists):
        monkeypatch.setattr(tuning, "NEIGHBOURS", replace(NEIGHBOURS, screened=screened, finalists=finalists))
        return fit_local(x, y, np.ones(1), np.arange(600), choices=choices)

    (every, left_out), (few, same) = fitted(600, 6), fitted(100, 2)
    assert few.settings == every.settings
    assert len(same.rows) == 600
    np.testing.assert_array_equal(same.answers.values, left_out.answers.values)


@pytest.mark.parametrize(
    ("groups", "choices", "features"),
    [(np.zeros(9), LOCAL_CHOICES, 1.0), (np.arange(9), (), 1.0), (np.arange(9), LOCAL_CHOICES, 0.0)],
)
def test_what_cannot_be_fitted_is_refused(groups, choices, features):
    x = features * np.random.default_rng(7).normal(size=(9, 3)).astype(np.float32)
    with pytest.raises(LocalizationError):
        fit_local(x, np.zeros((9, 2)), np.ones(2), groups, choices=choices)


SETTINGS = [LocalSettings(6, 12, 0.03, None)]


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, size=(600, 6)).astype(np.float32)
    y = poses_of(x)
    regression, left_out = fit_local(x, y, np.ones(7), np.arange(600), choices=SETTINGS)
    return NeighbourSource.of(regression, left_out, np.arange(600)), x, y


def answered(source, answers, novelty):
    """The source's estimates where its regression answers so, at a novelty in units of features."""
    told = LocalAnswers(answers.values, answers.weights, np.full(len(answers.values), novelty))
    relative = np.full(len(answers.values), novelty / source.typical)
    rows = zip(told.values, told.weights, relative.tolist(), strict=True)
    return [source._measurements(*row) for row in rows]


def test_errors_are_as_large_as_the_standard_deviations(world):
    source, _, _ = world
    x = np.random.default_rng(1).uniform(-0.9, 0.9, size=(400, 6)).astype(np.float32)
    truth = poses_of(x)
    estimates = [here[0] for here in source.answer(FrameEvidence(x)).measurements]
    off = np.array([np.linalg.norm(f.position_xyz - t[:3]) for f, t in zip(estimates, truth, strict=True)])
    sigma = np.array([f.sigma_m for f in estimates])
    # the median norm of three errors of spread one is 1.54
    assert np.median(off / sigma) == pytest.approx(1.54, rel=0.25)
    assert np.median([f.inlier_probability for f in estimates]) > 0.9
    turned = np.array(
        [2 * np.arccos(min(abs(f.orientation_quat_wxyz @ t[3:]), 1)) for f, t in zip(estimates, truth, strict=True)]
    )
    assert np.median(turned / [f.sigma_rad for f in estimates]) == pytest.approx(1.54, rel=0.5)  # about one axis only


def test_novel_images_have_wider_and_less_probable_estimates(world):
    source, x, _ = world
    answers = source.regression.predict(x[:50])
    estimates = [answered(source, answers, s)[0][0] for s in (source.typical, 3 * source.limit, 30 * source.limit)]
    probabilities, spreads = [f.inlier_probability for f in estimates], [f.sigma_m for f in estimates]
    assert probabilities[0] > 0.9
    assert probabilities[0] > probabilities[1] > probabilities[2]
    assert probabilities[2] < 1e-3
    assert spreads[0] < spreads[1] / 3 < spreads[2] / 10


def test_every_place_that_looks_alike_has_an_estimate_with_its_share_of_the_odds(world):
    source, _, y = world
    values = np.stack((y[0], y[1], y[2]))[None]
    shares = LocalAnswers(values, np.array([[0.25, 0.75, 0.0]]), np.ones(1))
    here = answered(source, shares, source.typical)[0]
    assert len(here) == 2  # a place without neighbours is none
    np.testing.assert_allclose(here[0].position_xyz, y[0, :3])
    odds = [one.inlier_probability / (1 - one.inlier_probability) for one in here]
    assert odds[1] == pytest.approx(3 * odds[0])
    # all together are as likely to be right as one place would be
    single = LocalAnswers(values, np.array([[1.0, 0.0, 0.0]]), np.ones(1))
    alone = answered(source, single, source.typical)[0][0]
    assert sum(odds) == pytest.approx(alone.inlier_probability / (1 - alone.inlier_probability))


def test_too_few_samples_make_no_source():
    x = np.random.default_rng(0).uniform(-1, 1, size=(12, 6)).astype(np.float32)
    regression, left_out = fit_local(x, poses_of(x), np.ones(7), np.arange(12), choices=SETTINGS)
    assert NeighbourSource.of(regression, left_out, np.arange(12)) is None


def test_fewer_references_than_neighbours_will_do():
    x, y, _ = two_places(6)
    found = regression(x, y, LocalSettings(2, 20, 0.1, 3.0)).predict(x.astype(np.float32))
    assert np.isfinite(found.values[found.weights > 0]).all()
