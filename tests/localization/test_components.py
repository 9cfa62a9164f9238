import numpy as np
import pytest

from conformodal.localization.neighbours.components import fit_components

ALL = slice(None)


def test_components_are_centred_uncorrelated_and_of_one_scale():
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(200, 5)) @ rng.normal(size=(5, 40)) + 3).astype(np.float32)
    x[:, 7] = 2.0  # a dead feature
    found = fit_components(x, 4, ALL)
    z = found.apply(x)
    assert z.shape == (200, 4)
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=1e-4)
    covariance = np.cov(z.T)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-3)
    assert np.trace(covariance) / 4 == pytest.approx(1, rel=1e-3)
    assert (np.diff(np.diag(covariance)) < 0).all()  # not whitened: the first matter most
    standard = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-3)
    values = np.sort(np.linalg.eigvalsh(np.cov(standard.T)))[::-1][:4]
    np.testing.assert_allclose(np.diag(covariance) / np.trace(covariance), values / values.sum(), rtol=1e-3)
    np.testing.assert_array_equal(found.leading(2).apply(x), z[:, :2])


def test_a_view_looks_at_some_features_and_no_others():
    x = np.random.default_rng(0).normal(size=(30, 10)).astype(np.float32)
    found, part = fit_components(x, 4, slice(2, 8)), fit_components(x[:, 2:8], 4, ALL)
    np.testing.assert_allclose(found.directions[2:8], part.directions)
    np.testing.assert_array_equal(found.directions[[0, 1, 8, 9]], 0)
    x[:, 2:8] = 1.0  # and there is nothing to see in this one
    assert fit_components(x, 4, slice(2, 8)) is None


@pytest.mark.parametrize(("n", "size"), [(3, 2), (50, 6)])
def test_there_are_no_more_components_than_samples_or_features_allow(n, size):
    x = np.random.default_rng(0).normal(size=(n, 6)).astype(np.float32)
    assert np.isfinite(fit_components(x, 256, ALL).apply(x)).all()
    assert fit_components(x, 256, ALL).directions.shape == (6, size)


@pytest.mark.parametrize("value", [0.1, 0.37, 117 / 255])
def test_equal_features_have_no_components_though_their_mean_is_rounded(value):
    assert fit_components(np.full((37, 9), value, dtype=np.float32), 4, ALL) is None
