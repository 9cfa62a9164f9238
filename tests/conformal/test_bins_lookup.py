import numpy as np

from conformodal.conformal import QuantileBins


def test_codes_of_many_values_are_those_of_a_search():
    rng = np.random.default_rng(0)
    y = np.concatenate((rng.standard_t(2, 100_000), [-1e9, 1e9]))
    bins = QuantileBins(50).fit(y[:5000])
    y = np.concatenate((y, np.repeat(bins.edges_[0], 3), np.nextafter(bins.edges_[0], -np.inf)))
    edges = bins.edges_[0]
    expected = np.searchsorted(edges, y, side="right") - 1
    expected[y == edges[-1]] = edges.size - 2
    expected[expected > edges.size - 2] = -1
    np.testing.assert_array_equal(bins.encode(y)[:, 0], expected)


def test_a_repeated_value_gets_a_bin_that_reaches_half_way_to_its_neighbours():
    np.testing.assert_allclose(QuantileBins(50).fit(np.repeat([0.0, 1.0], [90, 10])).edges_[0], [-0.5, 0.5, 1.5])
    edges = QuantileBins(10).fit(np.concatenate((np.linspace(-1, 1, 101), np.zeros(100)))).edges_[0]
    assert np.isin([-0.01, 0.01], np.round(edges, 9)).all()
    assert (np.diff(edges) > 0).all()
