import numpy as np
import pytest

from conformodal.conformal import QuantileBins, Regions
from conformodal.localizer.modes import interval_mixtures, mode_mixtures

K = 20


def bumps(*peaks):
    """A softmax row with Gaussian bumps at (bin coordinate, weight)."""
    at = np.arange(K) + 0.5
    p = sum(w * np.exp(-0.5 * ((at - c) / 0.8) ** 2) for c, w in peaks)
    return (p / p.sum())[None]


def pose_bins():
    edges = np.linspace(-1, 1, K + 1)
    return QuantileBins.from_edges([np.linspace(0, 20, K + 1) ** 1.2, *[np.linspace(0, 10, K + 1)] * 2, *[edges] * 4])


def identity_quat():
    return [bumps((19.5, 1.0)), *[bumps((10.0, 1.0))] * 3]


def test_every_mode_is_a_candidate_at_its_mean():
    proba = [bumps((4.3, 0.7), (15.6, 0.3)), bumps((10.0, 1)), bumps((5.0, 1)), *identity_quat()]
    found = mode_mixtures(proba, pose_bins())[0]
    expected = np.interp([4.3, 15.6], np.arange(K + 1), pose_bins().edges_[0])
    np.testing.assert_allclose(found.positions_xyz[:, 0], expected, rtol=0.02)
    np.testing.assert_allclose(np.exp(np.diff(found.log_weights)), 0.3 / 0.7, rtol=0.01)
    np.testing.assert_allclose(found.positions_xyz[:, 1:], [[5, 2.5]] * 2, atol=0.02)
    assert abs(found.orientations_quat_wxyz[0, 0]) > 0.99


def test_candidates_are_bounded_and_keep_the_most_probable(monkeypatch):
    many = bumps(*[(c, 1.0) for c in (2, 10, 18)])
    proba = [many, many, many, *identity_quat()]
    monkeypatch.setattr("conformodal.localizer.modes.MAX_HYPOTHESES", 10)
    found = mode_mixtures(proba, pose_bins())[0]
    assert len(found.positions_xyz) == 10
    assert (np.diff(found.log_weights) <= 1e-12).all()
    monkeypatch.setattr("conformodal.localizer.modes.MIN_MASS", 0.9)
    few = mode_mixtures(proba, pose_bins())[0]
    assert len(few.positions_xyz) == 1  # never none


def test_empty_set_is_represented_by_its_best_bin():
    """Intervals are represented by their own means."""
    proba = [bumps((4.5, 0.6), (15.5, 0.4)), bumps((10.0, 1)), bumps((5.5, 1)), *identity_quat()]
    bins = pose_bins()
    masks = [np.ones((1, K), bool) for _ in range(7)]
    masks[0][:] = False
    masks[0][0, [4, 15]] = True
    masks[2][:] = False
    found = interval_mixtures(proba, Regions(bins, masks, np.zeros((1, 7), bool)))[0]
    np.testing.assert_allclose(found.positions_xyz[:, 0], bins.centers[0][[4, 15]], rtol=1e-6)
    np.testing.assert_allclose(found.positions_xyz[:, 2], bins.centers[2][5], rtol=1e-6)


@pytest.mark.parametrize(("apart", "n_modes"), [(1, 1), (3, 1), (5, 2), (9, 2)])
def test_peaks_are_modes_where_little_lies_between(apart, n_modes):
    proba = [bumps((5.5, 0.6), (5.5 + apart, 0.4)), *[bumps((10.0, 1))] * 2, *identity_quat()]
    assert len(mode_mixtures(proba, pose_bins())[0].positions_xyz) == n_modes


def test_components_that_cancel_give_an_orientation_of_no_weight():
    centre = bumps((10.0, 1.0))  # 0 in every component
    found = mode_mixtures([centre] * 7, pose_bins())[0]
    assert np.isfinite(found.orientations_quat_wxyz).all()
