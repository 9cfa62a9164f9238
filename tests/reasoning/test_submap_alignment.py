from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import Submap, angle_between_quats
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.errors import ReasoningError
from conformodal.reasoning.observations import Observations
from conformodal.reasoning.orientations import smooth_orientations
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.smoother import smooth_positions

DEPTH = 2.0
PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.5, 1.5), (0.5, 0.5), DEPTH, 0.2)


def path(n=40):
    t = np.arange(n) * 0.1
    positions = np.column_stack((np.sin(t), 0.4 * t, 0.1 * np.cos(2 * t)))
    rotations = Rotation.from_euler("zyx", np.column_stack((0.4 * t, 0.1 * np.sin(t), 0 * t)))
    return t, positions, rotations


def exact_submaps(positions, rotations, span=15, hop=7, depth=DEPTH, sigma=0.01):
    """Submaps of the exact path, each in a unit of its own."""
    found = []
    for k, start in enumerate(range(0, len(positions) - span + 1, hop)):
        frames = np.arange(start, start + span, 2)
        unit = 0.3 + 0.1 * k
        relative = rotations[start].inv() * rotations[frames]
        places = rotations[start].inv().apply(positions[frames] - positions[start]) / unit
        found.append(Submap(frames, relative.as_matrix(), places, depth / unit, sigma, np.radians(0.5)))
    return found


def rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=1)))


def test_submaps_carry_a_path_through_answers_that_err_for_long():
    t, positions, rotations = path(43)
    quats = rotations.as_quat(scalar_first=True)
    noisy = positions + np.random.default_rng(0).normal(size=positions.shape) * 0.02
    noisy[12:24] += [0.3, -0.2, 0.1]  # twelve frames that are all off the same way
    spreads = np.full(noisy.shape, 0.03)
    alone = smooth_positions(noisy, spreads, quats, t, PRIOR)
    together = smooth_positions(noisy, spreads, quats, t, PRIOR, exact_submaps(positions, rotations))
    assert rms(alone - positions) > 0.15
    assert rms(together - positions) < 0.35 * rms(alone - positions)


def test_exact_answers_stay_and_tell_the_length():
    t, positions, rotations = path(29)
    quats = rotations.as_quat(scalar_first=True)
    submaps = exact_submaps(positions, rotations, depth=1.2 * DEPTH)  # depths lead to expect a longer path
    found = smooth_positions(positions, np.full((29, 3), 0.001), quats, t, PRIOR, submaps)
    assert rms(found - positions) < 0.005


@pytest.mark.parametrize("depth", [0.5 * DEPTH, DEPTH])
def test_where_answers_say_nothing_depths_tell_the_length(depth):
    """All frames are answered with one place, so only the depths to expect keep the path from shrinking to it."""
    t, positions, rotations = path(15)
    quats = rotations.as_quat(scalar_first=True)
    lost = np.tile(positions.mean(axis=0), (15, 1))
    submaps = exact_submaps(positions, rotations, depth=depth, sigma=0.001)
    found = smooth_positions(lost, np.full((15, 3), 5.0), quats, t, PRIOR, submaps)
    extent, truth = (np.linalg.norm(p[-1] - p[0]) for p in (found, positions))
    assert extent / truth == pytest.approx(DEPTH / depth, rel=0.1)


def test_an_orientation_that_is_off_does_not_bend_what_answers_say():
    t, positions, rotations = path(29)
    off = Rotation.from_rotvec([0, 0, np.radians(8)]) * rotations
    submaps = exact_submaps(positions, rotations)
    found = smooth_positions(positions, np.full((29, 3), 0.002), off.as_quat(scalar_first=True), t, PRIOR, submaps)
    assert rms(found - positions) < 0.01


def test_without_depths_to_expect_submaps_turn_but_do_not_place():
    t, positions, rotations = path(29)
    quats = rotations.as_quat(scalar_first=True)
    unknown = replace(PRIOR, depth_m=np.nan, depth_spread=np.nan)
    noisy = positions + np.random.default_rng(0).normal(size=positions.shape) * 0.05
    submaps = exact_submaps(positions, rotations)
    arguments = noisy, np.full(noisy.shape, 0.05), quats, t
    np.testing.assert_array_equal(smooth_positions(*arguments, unknown, submaps), smooth_positions(*arguments, unknown))
    assert np.abs(smooth_positions(*arguments, PRIOR, submaps) - smooth_positions(*arguments, PRIOR)).max() > 1e-3


def test_submaps_turn_orientations_that_err_for_long():
    t, positions, rotations = path(43)
    truth = rotations.as_quat(scalar_first=True)
    turned = Rotation.from_rotvec(np.where((np.arange(43) // 9 == 2)[:, None], [0.0, 0.3, 0.0], 0.0)) * rotations
    quats, spreads = turned.as_quat(scalar_first=True), np.full(43, 0.05)
    submaps = exact_submaps(positions, rotations)
    alone = smooth_orientations(quats, spreads, [None] * 43, t, PRIOR)
    together = smooth_orientations(quats, spreads, [None] * 43, t, PRIOR, submaps)
    error = [np.sqrt(np.mean(angle_between_quats(q, truth) ** 2)) for q in (alone, together)]
    assert error[1] < 0.5 * error[0]


def test_submaps_of_other_frames_are_refused():
    t, positions, rotations = path(15)
    (submap,) = exact_submaps(positions, rotations)
    one = Candidates(np.zeros((1, 3)), np.ones((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones(1), np.zeros(1))
    Observations([one] * 15, [None] * 15, t, [submap])
    with pytest.raises(ReasoningError, match="not one of 14 frames"):
        Observations([one] * 14, [None] * 14, t[:14], [submap])
