import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.conformal import grouped_maximum_quantile, grouped_quantile
from conformodal.odometry import OdometryRun, Promise, fit_pose_radius, pose_errors, recording_errors
from conformodal.poses import Trajectory


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


def test_each_half_of_alpha_goes_to_one_error():
    rng = np.random.default_rng(1)
    errors = [(rng.random(k), rng.random(k)) for k in rng.integers(2, 9, 30)]
    for promise, quantile in ((Promise.FRAME, grouped_quantile), (Promise.RECORDING, grouped_maximum_quantile)):
        radius = fit_pose_radius(errors, 0.2, promise, "smoothed")
        assert radius.radius_m == quantile([e[0] for e in errors], 0.1)
        assert radius.radius_rad == quantile([e[1] for e in errors], 0.1)
        assert radius.n_recordings == 30
    assert radius.radius_m > fit_pose_radius(errors, 0.2, Promise.FRAME, "smoothed").radius_m


def test_the_radius_holds_both_errors_or_not():
    truth = trajectory(3, 2)
    turn = Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)
    turned = turn * Rotation.from_rotvec([[0, 0, 0.1], [0, 0, 0.3], [0, 0, 0.1]])
    moved = truth.positions_xyz + np.array([[0.1, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    radius = fit_pose_radius([([0.2], [0.2])] * 9, 0.5, Promise.FRAME, "smoothed")
    estimate = Trajectory(truth.timestamps_s, moved, turned.as_quat(scalar_first=True))
    assert radius.holds(estimate, truth).tolist() == [True, False, False]
    assert "a frame drawn at random" in radius.assumption


def test_frames_that_could_not_be_read_are_infinitely_far_off():
    truth = trajectory(6, 3)
    run = OdometryRun(np.array([0, 1, 3, 4, 5]), truth.timestamps_s[[0, 1, 3, 4, 5]], None, [], [], [], [], {})
    run.trajectories["smoothed"] = truth[np.array([0, 1, 3, 4, 5])]
    errors = recording_errors(run, "smoothed", truth, np.array([0, 0, 0, 1, 1, 1]))
    assert [e[0].tolist() for e in errors] == [[0, 0, np.inf], [0, 0, 0]]
    assert fit_pose_radius(errors, 0.9, Promise.RECORDING, "smoothed").radius_m == np.inf
    assert fit_pose_radius(errors, 0.9, Promise.FRAME, "smoothed").radius_m == pytest.approx(0)
