from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.conformal import hierarchical_maximum_quantile, hierarchical_quantile
from conformodal.geometry import Trajectory
from conformodal.localizer import LocalizationError
from conformodal.localizer.radius import Guarantee, fit_pose_radius, pose_errors, recordings_needed
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.train import recording_errors


def trajectory(n, seed):
    rng = np.random.default_rng(seed)
    return Trajectory(np.arange(float(n)), rng.normal(size=(n, 3)), Rotation.random(n, rng).as_quat(scalar_first=True))


def test_errors_are_distances_and_angles():
    a = trajectory(4, 0)
    turned = Rotation.from_quat(a.orientations_quat_wxyz, scalar_first=True) * Rotation.from_rotvec([0, 0.3, 0])
    b = Trajectory(a.timestamps_s, a.positions_xyz + np.array([0, 3, 4]), -turned.as_quat(scalar_first=True))
    position, angle = pose_errors(b, a)
    np.testing.assert_allclose(position, 5)
    np.testing.assert_allclose(angle, 0.3)


def test_one_threshold_holds_the_larger_of_both_errors():
    rng = np.random.default_rng(1)
    errors = [(rng.random(k), rng.random(k)) for k in rng.integers(2, 9, 30)]
    for guarantee, quantile in (
        (Guarantee.FRAME, hierarchical_quantile),
        (Guarantee.RECORDING, hierarchical_maximum_quantile),
    ):
        radius = fit_pose_radius(errors, 0.2, guarantee, "smoothed", metres_per_rad=4.0)
        scores = [np.maximum(m / 4, r) for m, r in errors]
        assert radius.radius_rad == quantile(scores, 0.2)
        assert radius.radius_m == 4 * radius.radius_rad
        assert radius.radius_deg == pytest.approx(np.degrees(radius.radius_rad))
        assert replace(radius, radius_rad=1000.0).radius_deg == 180
        assert radius.n_recordings == 30


def test_nine_recordings_suffice_for_a_tenth():
    assert [recordings_needed(alpha) for alpha in (0.1, "0.05", 0.3, 0.5)] == [9, 19, 3, 1]
    rng = np.random.default_rng(2)
    errors = [(rng.random(5), rng.random(5)) for _ in range(9)]
    for guarantee in Guarantee:
        assert fit_pose_radius(errors[:8], 0.1, guarantee, "smoothed").radius_rad == np.inf
        assert np.isfinite(fit_pose_radius(errors, 0.1, guarantee, "smoothed").radius_rad)


def test_the_radius_holds_both_errors_or_not():
    truth = trajectory(3, 2)
    turn = Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)
    turned = turn * Rotation.from_rotvec([[0, 0, 0.1], [0, 0, 0.3], [0, 0, 0.1]])
    moved = truth.positions_xyz + np.array([[0.1, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    radius = fit_pose_radius([([0.2], [0.2])] * 9, 0.5, Guarantee.FRAME, "smoothed", metres_per_rad=1.0)
    estimate = Trajectory(truth.timestamps_s, moved, turned.as_quat(scalar_first=True))
    assert radius.holds(estimate, truth).tolist() == [True, False, False]
    assert "a frame drawn at random" in radius.assumption


def test_frames_that_could_not_be_read_are_infinitely_far_off():
    truth = trajectory(6, 3)
    run = OdometryRun(None, np.array([0, 1, 3, 4, 5]), np.array([0, 0, 1, 1, 1]), [], {}, "smoothed")
    run.trajectories["smoothed"] = truth[np.array([0, 1, 3, 4, 5])]
    errors = recording_errors(run, "smoothed", truth, np.array([0, 0, 0, 1, 1, 1]))
    assert [e[0].tolist() for e in errors] == [[0, 0, np.inf], [0, 0, 0]]
    assert fit_pose_radius(errors, 0.45, Guarantee.RECORDING, "smoothed").radius_m == np.inf
    assert fit_pose_radius(errors, 0.9, Guarantee.FRAME, "smoothed").radius_m == pytest.approx(0)


@pytest.mark.parametrize("metres_per_rad", [0.0, -1.0, np.nan, np.inf])
def test_a_weight_that_makes_no_radius_is_refused(metres_per_rad):
    with pytest.raises(LocalizationError, match="metres_per_rad"):
        fit_pose_radius([([0.2], [0.2])] * 9, 0.5, Guarantee.FRAME, "smoothed", metres_per_rad=metres_per_rad)
