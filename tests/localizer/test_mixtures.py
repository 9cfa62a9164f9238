"""Mixtures of poses: weights that sum to one, parts, and pools."""

import numpy as np
import pytest

from conformodal.localizer.filter import start
from conformodal.localizer.mixtures import PoseMixture, Share, pool

UPRIGHT = np.array([1.0, 0, 0, 0])


def mixture(*weights, measured=True):
    m = len(weights)
    poses = np.arange(3.0 * m).reshape(m, 3), np.ones((m, 3)), np.tile(UPRIGHT, (m, 1)), np.ones(m)
    return PoseMixture.weighted(*poses, np.log(weights), measured=measured)


def test_weights_that_do_not_sum_to_one_are_refused():
    one = mixture(3, 1)
    np.testing.assert_allclose(one.weights, [0.75, 0.25])
    poses = one.positions_xyz, one.position_spreads, one.orientations_quat_wxyz, one.orientation_spreads_rad
    for weights in ([0.5, 0.4], [0.5, 0.6]):
        with pytest.raises(ValueError, match=r"must sum to 1, got (0\.9|1\.1)"):
            PoseMixture(*poses, np.log(weights), one.measured)


def test_a_part_and_other_weights_sum_to_one():
    one = mixture(2, 1, 1)
    part = one.part(np.array([2, 0]))
    np.testing.assert_allclose(part.weights, [1 / 3, 2 / 3])
    np.testing.assert_array_equal(part.positions_xyz, one.positions_xyz[[2, 0]])
    np.testing.assert_allclose(one.reweighted(np.log([1, 1, 6])).weights, [1 / 8, 1 / 8, 6 / 8])


def test_a_pool_holds_all_hypotheses_by_the_ratio_of_the_shares():
    found = pool([Share(mixture(1, 3), np.log(2)), Share(mixture(1, measured=False), np.log(6))])
    np.testing.assert_allclose(found.weights, [0.25 / 4, 0.25 * 3 / 4, 0.75])
    assert found.measured.tolist() == [True, True, False]


def test_posterior_hypotheses_count_as_measured():
    """Regions from the frames so far take them as densities; of an image, modes of the softmax are taken as bins."""
    image = mixture(3, 1, measured=False)
    first = start(image, known=True)
    assert first.hypotheses.measured.all()
    np.testing.assert_array_equal(first.hypotheses.log_weights, image.log_weights)
    joined = first.with_image(image, 0.1)
    assert joined.measured.tolist() == [True, True, False, False]
