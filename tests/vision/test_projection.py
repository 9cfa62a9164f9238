import numpy as np
import pytest
import torch

from conformodal.networks.heads import Head
from conformodal.vision.projection import fit_projection


def test_projected_features_are_centred_uncorrelated_and_of_one_scale():
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(200, 5)) @ rng.normal(size=(5, 40)) + 3).astype(np.float32)
    x[:, 7] = 2.0  # a dead feature
    through = fit_projection(x, 4)
    z = (x - through.offset) @ through.components
    assert through.size == 4
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=1e-4)
    covariance = np.cov(z.T)
    np.testing.assert_allclose(covariance, np.diag(np.diag(covariance)), atol=1e-3)
    assert np.trace(covariance) / 4 == pytest.approx(1, rel=1e-3)
    assert (np.diff(np.diag(covariance)) < 0).all()  # not whitened: the first matter most
    standard = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-3)
    values = np.sort(np.linalg.eigvalsh(np.cov(standard.T)))[::-1][:4]
    np.testing.assert_allclose(np.diag(covariance) / np.trace(covariance), values / values.sum(), rtol=1e-3)


@pytest.mark.parametrize("components", [4, None])
def test_a_view_looks_at_some_features_and_no_others(components):
    x = np.random.default_rng(0).normal(size=(30, 10)).astype(np.float32)
    through, part = fit_projection(x, components, slice(2, 8)), fit_projection(x[:, 2:8], components)
    assert through.size == (10 if components is None else 4)
    np.testing.assert_allclose(through.components[2:8], part.components)
    np.testing.assert_array_equal(through.components[[0, 1, 8, 9]], 0)


@pytest.mark.parametrize(("n", "components", "size"), [(3, 256, 2), (50, 256, 6), (50, None, 6)])
def test_a_projection_has_no_more_directions_than_samples_or_features_allow(n, components, size):
    x = np.random.default_rng(0).normal(size=(n, 6)).astype(np.float32)
    through = fit_projection(x, components)
    assert through.size == size
    head = Head(through, [2])
    z = head.project(torch.from_numpy(x)).numpy()
    assert np.isfinite(z).all()
    if components is None:
        np.testing.assert_allclose(z.std(axis=0), 1, rtol=2e-3)
    np.testing.assert_array_equal(head.projection.components, through.components)


@pytest.mark.parametrize("value", [0.1, 0.37, 117 / 255])
def test_equal_features_have_no_directions_though_their_mean_is_rounded(value):
    through = fit_projection(np.full((37, 9), value, dtype=np.float32), 4)
    assert through.components.shape == (9,)
    assert np.abs(through.apply(np.full((1, 9), value, dtype=np.float32))).max() < 1e-3
