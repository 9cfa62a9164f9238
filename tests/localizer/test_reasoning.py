from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Submap, Trajectory, angle_between_quats
from conformodal.localizer import LocalizationError
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import Observations, PosePath, fit_motion_prior
from conformodal.localizer.smoother import image_hypotheses, smooth_orientations, smooth_positions
from tests.localizer.flights import PRIOR, exact_motions, path


def test_smoothing_improves_on_noise():
    rng = np.random.default_rng(1)
    t, positions, rotations = path(200)
    motions = exact_motions(positions, rotations)
    motions[50] = None
    truth = Trajectory(t, positions, rotations.as_quat(scalar_first=True))
    noisy_q = (Rotation.from_rotvec(rng.normal(size=(200, 3)) * 0.03) * rotations).as_quat(scalar_first=True)
    noisy_p = positions + rng.normal(size=(200, 3)) * 0.1
    noisy_p[100] += 3  # one wrong mode
    q = smooth_orientations(noisy_q, np.full(200, 0.03), motions, t, PRIOR)
    p = smooth_positions(noisy_p, np.full((200, 3), 0.1), q, t, PRIOR)

    def rms(x):
        return np.sqrt(np.mean(x**2))

    before_q = angle_between_quats(noisy_q, truth.orientations_quat_wxyz)
    assert rms(angle_between_quats(q, truth.orientations_quat_wxyz)) < 0.4 * rms(before_q)
    error = np.linalg.norm(p - positions, axis=1)
    assert rms(error) < 0.09  # 0.17 before, without the outlier
    assert error[100] < 0.4


def test_smoothing_keeps_what_is_exact_and_short():
    t, positions, rotations = path(30)
    quats = rotations.as_quat(scalar_first=True)
    motions = exact_motions(positions, rotations)
    same = smooth_orientations(quats, np.full(30, 0.02), motions, t, PRIOR)
    np.testing.assert_allclose(angle_between_quats(same, quats), 0, atol=1e-6)
    assert smooth_orientations(quats[:1], np.ones(1), motions[:1], t[:1], PRIOR).shape == (1, 4)
    assert smooth_positions(positions[:2], np.ones((2, 3)), quats[:2], t[:2], PRIOR).shape == (2, 3)


@pytest.mark.parametrize("density", [1e-12, 1e-8, 0.5])
def test_smoothed_positions_do_not_depend_on_the_origin_of_the_world(density):
    """UTM coordinates reach millions of metres; 300 of 600 frames show no known place."""
    rng = np.random.default_rng(0)
    t = np.arange(600) / 30
    positions = np.outer(t, [0.5, 0.1, 0.0]) + rng.normal(0, 0.02, (600, 3))
    spreads = np.full((600, 3), 0.02)
    spreads[200:500] = 1e3
    quats, prior = np.tile([1.0, 0, 0, 0], (600, 1)), replace(PRIOR, acceleration_density=(density, density))
    origin = np.array([5e6, 1e6, 100.0])
    near = smooth_positions(positions, spreads, quats, t, prior)
    far = smooth_positions(positions + origin, spreads, quats, t, prior) - origin
    np.testing.assert_allclose(far, near, atol=0.02)


def test_smoother_overrides_only_gross_errors():
    """An answer is kept that misses its standard deviation by little beside the depth."""
    t, positions, rotations = path(60)
    quats = rotations.as_quat(scalar_first=True)
    calm = replace(PRIOR, acceleration_density=(0.005, 0.005))
    off, spreads = positions.copy(), np.full((60, 3), 0.001)
    off[20, 0] += 0.02  # a jerk: twenty times the claim, but little beside a depth of two metres
    off[40, 0] += 0.5
    found, blind = (smooth_positions(off, spreads, quats, t, prior) for prior in (replace(calm, depth_m=2.0), calm))
    assert blind[20, 0] - positions[20, 0] < 0.01 < 0.015 < found[20, 0] - positions[20, 0]
    assert abs(found[40, 0] - positions[40, 0]) < 0.01


def test_prior_learns_speeds_and_turns():
    t = np.arange(400) * 0.1
    circle = np.column_stack((2 * np.cos(0.5 * t), 2 * np.sin(0.5 * t), 0 * t))
    quats = Rotation.from_rotvec(np.column_stack((0 * t, 0 * t, 0.5 * t))).as_quat(scalar_first=True)
    prior = fit_motion_prior(Trajectory(t, circle, quats), np.zeros(400, int))
    assert prior.turn_rate_rad_s == pytest.approx(0.5, rel=0.01)
    assert prior.reach_m(0.1) == pytest.approx(0.11, rel=0.01)  # 1 m/s and a tenth more
    assert (np.diff(prior.intervals_s) > 0).all()
    with pytest.raises(LocalizationError, match="three frames"):
        fit_motion_prior(Trajectory(t[:2], circle[:2], quats[:2]), np.zeros(2, int))


DEPTH = 2.0
DEEP = replace(PRIOR, depth_m=DEPTH, depth_spread=0.2)


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
    alone = smooth_positions(noisy, spreads, quats, t, DEEP)
    together = smooth_positions(noisy, spreads, quats, t, DEEP, exact_submaps(positions, rotations))
    assert rms(alone - positions) > 0.15
    assert rms(together - positions) < 0.35 * rms(alone - positions)


def test_smoother_starts_narrow_at_known_images():
    """From the core of their errors; it is wide elsewhere."""
    t, positions, rotations = path(2)
    quats, spreads = rotations.as_quat(scalar_first=True), np.full((2, 3), 0.03)
    frames = [
        PoseMixture.weighted(positions[i : i + 1], spreads[:1], quats[i : i + 1], np.array([0.02]), np.zeros(1))
        for i in (0, 1)
    ]
    start = PosePath(t, positions + 0.01, 2 * spreads, quats, np.full(2, 0.04))
    found = image_hypotheses(start, Observations(frames, [None] * 2, t, known=np.array([True, False])), DEEP)
    np.testing.assert_array_equal(found.positions_xyz, positions)
    np.testing.assert_allclose(found.position_spreads[0], 0.6 * 0.03)
    np.testing.assert_allclose(found.orientation_spreads_rad[0], 0.6 * 0.02)
    np.testing.assert_allclose(found.position_spreads[1], 0.2 * DEEP.depth_m)
    np.testing.assert_allclose(found.orientation_spreads_rad[1], 0.5)
    elsewhere = replace(start, positions_xyz=start.positions_xyz + DEEP.depth_m)  # the image speaks for another place
    found = image_hypotheses(elsewhere, Observations(frames, [None] * 2, t), DEEP)
    np.testing.assert_array_equal(found.positions_xyz, elsewhere.positions_xyz)
    np.testing.assert_array_equal(found.position_spreads, elsewhere.position_spreads)
