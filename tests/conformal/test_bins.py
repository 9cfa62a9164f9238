import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from conformodal.conformal import QuantileBins

finite = st.floats(-1e6, 1e6, allow_nan=False)


def test_bins_hold_equal_shares():
    y = np.random.default_rng(0).exponential(size=1000)
    codes = QuantileBins(20).fit(y).encode(y)
    assert np.bincount(codes[:, 0]).tolist() == [50] * 20


@given(hnp.arrays(np.float64, st.integers(1, 40), elements=finite), st.integers(1, 12))
def test_every_training_value_is_in_the_bin_its_code_says(y, k):
    bins = QuantileBins(k).fit(y)
    edges, codes = bins.edges_[0], bins.encode(y)[:, 0]
    assert (np.diff(edges) > 0).all()
    assert (codes >= 0).all()
    assert (edges[codes] <= y).all()
    assert (y <= edges[codes + 1]).all()


def test_edges_belong_to_the_bin_above_and_the_last_to_the_last():
    bins = QuantileBins.from_edges([[0.0, 1.0, 2.0]])
    assert bins.encode([0.0, 1.0, 2.0, -1e-12, 2.0000001])[:, 0].tolist() == [0, 1, 1, -1, -1]


def test_repeated_and_constant_values():
    two = QuantileBins(10).fit([1.0] * 50 + [2.0] * 50)
    assert two.sizes == [2]  # ten bins would be empty but for the median between the two values
    assert two.encode([1.0, 2.0])[:, 0].tolist() == [0, 1]
    constant = QuantileBins(10).fit(np.full(5, 3.0))
    assert constant.sizes == [1]
    assert constant.encode([3.0, 3.1])[:, 0].tolist() == [0, -1]


def test_soft_targets_are_centred_on_the_true_value():
    bins = QuantileBins.from_edges([np.array([0.0, 1, 3, 6, 10, 15])])
    y = np.array([4.5, 3.0, 12.0])
    soft = bins.soft_targets(y, 0.7)[0]
    np.testing.assert_allclose(soft.sum(axis=1), 1)
    assert soft[0].argmax() == 2
    place = soft[0] @ (np.arange(5) + 0.5)
    assert place == pytest.approx(2.5, abs=0.02)  # 4.5 lies half-way through bin 2
    one_hot = bins.soft_targets(y, 0)[0]
    assert one_hot.argmax(axis=1).tolist() == [2, 2, 4]
    assert set(one_hot.ravel()) == {0.0, 1.0}
    outside = bins.soft_targets(np.array([-100.0, 100.0]), 0.7)[0]
    assert outside.argmax(axis=1).tolist() == [0, 4]


def test_repeated_values_get_their_own_bin():
    """It reaches half-way to the neighbouring values."""
    np.testing.assert_allclose(QuantileBins(50).fit(np.repeat([0.0, 1.0], [90, 10])).edges_[0], [-0.5, 0.5, 1.5])
    edges = QuantileBins(10).fit(np.concatenate((np.linspace(-1, 1, 101), np.zeros(100)))).edges_[0]
    assert np.isin([-0.01, 0.01], np.round(edges, 9)).all()
    assert (np.diff(edges) > 0).all()
