import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import PoseError, Trajectory, read_kitti, relative_errors
from conformodal.poses.metrics import kitti_drift


def road(n=1200, step=1.0, turn_deg=0.0, scale=1.0):
    """A drive along z, a metre a frame, turning about y by `turn_deg` every metre."""
    headings = np.radians(turn_deg) * np.arange(n)
    rotation = Rotation.from_rotvec(np.column_stack((0 * headings, headings, 0 * headings)))
    steps = rotation[:-1].apply([0, 0, step * scale])
    positions = np.concatenate(([[0, 0, 0]], np.cumsum(steps, axis=0)))
    return Trajectory(np.arange(n) * 0.1, positions, rotation.as_quat(scalar_first=True))


def test_a_drive_that_is_one_per_cent_too_long_drifts_by_one_per_cent():
    percent, deg_per_m = kitti_drift(road(scale=1.01), road())
    # a stretch ends at the first frame beyond its length: 101 m for 100 m
    assert percent == pytest.approx(1, rel=0.02)
    assert deg_per_m == pytest.approx(0, abs=1e-9)


def test_a_wheel_that_pulls_to_one_side_drifts_in_degrees_a_metre():
    percent, deg_per_m = kitti_drift(road(n=120, turn_deg=0.01), road(n=120))  # long enough for 100 m alone
    assert deg_per_m == pytest.approx(0.01, rel=0.02)
    assert percent == pytest.approx(100 * np.radians(0.01) * 101 / 2, rel=0.05)  # half the angle off


def test_the_truth_has_no_drift_and_short_roads_have_none_to_measure(real_data):
    truth = read_kitti(real_data("trajectories", "kitti", "06.txt"))
    percent, deg_per_m = kitti_drift(truth, truth)
    assert percent == 0
    assert deg_per_m == pytest.approx(0, abs=1e-9)
    with pytest.raises(PoseError, match="at least 100 m"):
        kitti_drift(road(50), road(50))
    with pytest.raises(PoseError, match="pair them"):
        kitti_drift(road(500), road(501))


def test_relative_errors_are_those_of_the_motion_alone():
    truth = road(20, turn_deg=3)
    away = Rotation.from_rotvec([0.3, -1, 2])
    turned = away * Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)
    moved = Trajectory(truth.timestamps_s, away.apply(truth.positions_xyz) + 7, turned.as_quat(scalar_first=True))
    metres, degrees = relative_errors(moved, truth, 4)
    assert metres.shape == degrees.shape == (16,)
    np.testing.assert_allclose(metres, 0, atol=1e-9)
    np.testing.assert_allclose(degrees, 0, atol=1e-5)
    metres, degrees = relative_errors(road(20, turn_deg=5), truth, 2)
    np.testing.assert_allclose(degrees, 4, rtol=1e-9)
    for delta in (0, 20):
        with pytest.raises(PoseError, match="delta"):
            relative_errors(truth, truth, delta)
