import numpy as np
import pytest

from conformodal.conformal import PredictiveDensity, QuantileBins, SplitConformal

BINS = QuantileBins.from_edges([[0, 1, 2, 4], [-1, 0, 3]])
RNG = np.random.default_rng(0)
PROBA = [RNG.dirichlet(np.ones(3), 50), RNG.dirichlet(np.ones(2), 50)]


@pytest.fixture
def density():
    return PredictiveDensity(BINS, PROBA)


def test_the_density_integrates_to_the_distribution(density):
    grid = np.linspace(-1.5, 4.5, 12_001)
    for j in range(2):
        at = np.array([density.pdf(np.full((50, 2), value))[:, j] for value in grid[::100]])
        assert (at >= 0).all()
        reached = np.array([density.cdf(np.full((50, 2), value))[:, j] for value in grid[::100]])
        np.testing.assert_allclose(np.cumsum(at, axis=0) * 0.05, reached, atol=0.06)
        np.testing.assert_array_equal(reached[[0, -1]], [np.zeros(50), reached[-1]])
        np.testing.assert_allclose(reached[-1], 1)


def test_quantiles_invert_the_distribution(density):
    for q in (0.0, 0.1, 0.5, 0.99, 1.0):
        np.testing.assert_allclose(density.cdf(density.quantile(q)), q, atol=1e-12)


def test_samples_have_the_mean_and_lie_in_the_bins(density):
    drawn = density.sample(4000, random_state=0)
    assert drawn.shape == (4000, 50, 2)
    np.testing.assert_allclose(drawn.mean(axis=0), density.mean, atol=0.12)
    assert (BINS.encode(drawn.reshape(-1, 2)) >= 0).all()


def test_the_mode_is_in_the_densest_bin(density):
    proba, widths = PROBA[0], np.array([1, 1, 2])
    np.testing.assert_array_equal(BINS.encode(density.mode)[:, 0], (proba / widths).argmax(axis=1))


def test_each_interval_has_its_probability(density):
    y = density.sample(random_state=1)[0]
    regions = SplitConformal(BINS, 0.3, "density").calibrate(PROBA, y).predict(PROBA)
    for j, (mask, proba) in enumerate(zip(regions.masks, PROBA, strict=True)):
        offsets, _ = regions.flat_intervals(j)
        for i, parts in enumerate(np.split(density.flat_probabilities(regions, j), offsets[1:-1])):
            assert parts.sum() == pytest.approx((proba[i] * mask[i]).sum())
