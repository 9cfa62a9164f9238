"""Errors of a ground truth, found from an estimate that has noise and some wrong places."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory
from conformodal.io.diagnosis.axes import describe_axes, parse_axes
from conformodal.io.diagnosis.clocks import describe_time_offset
from conformodal.io.diagnosis.trajectories import doubt_truth

RATE_HZ, N = 10, 600
MOUNT = Rotation.from_euler("xyz", [-90, 0, 90], degrees=True)


@pytest.fixture
def truth():
    rng = np.random.default_rng(0)
    positions = np.cumsum(gaussian_filter1d(rng.normal(size=(N, 3)), 8, axis=0), axis=0)
    turns = np.cumsum(gaussian_filter1d(rng.normal(size=(N, 3)), 8, axis=0), axis=0)
    return Trajectory(np.arange(N) / RATE_HZ, positions, Rotation.from_rotvec(turns).as_quat(scalar_first=True))


@pytest.fixture
def estimate(truth):
    rng = np.random.default_rng(1)
    positions = truth.positions_xyz + rng.normal(scale=0.003, size=(N, 3))
    positions[rng.permutation(N)[: N // 20]] += 4.0
    noise = Rotation.from_rotvec(rng.normal(scale=0.01, size=(N, 3)))
    turned = Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True) * noise
    return Trajectory(truth.timestamps_s, positions, turned.as_quat(scalar_first=True))


def turned(path, left=None, right=None, lever=(0, 0, 0)):
    """Another body's poses, of axes `right`, or poses in another world, of axes `left`."""
    rotation = Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True)
    positions = path.positions_xyz + rotation.apply(lever)
    if left is not None:
        positions, rotation = left.apply(positions), left * rotation
    rotation = rotation if right is None else rotation * right
    return Trajectory(path.timestamps_s, positions, rotation.as_quat(scalar_first=True))


def test_a_sound_truth_is_not_doubted(estimate, truth):
    assert doubt_truth(estimate, truth).reasons == ()
    assert describe_time_offset(estimate, truth) == ""
    assert describe_time_offset(estimate, truth[::3]) == ""  # a truth of a lower rate


@pytest.mark.parametrize("quat", [[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5]])
def test_constant_orientations_are_none(estimate, truth, quat):
    doubts = doubt_truth(estimate, replace(truth, orientations_quat_wxyz=np.tile(quat, (N, 1))))
    assert doubts.positions_only
    assert "all the same" in doubts.reasons[0]


def test_a_camera_that_does_not_turn_has_constant_orientations(estimate, truth):
    still = np.tile([1.0, 0, 0, 0], (N, 1))
    both = [replace(path, orientations_quat_wxyz=still) for path in (estimate, truth)]
    assert not doubt_truth(*both).positions_only


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        (lambda t: replace(t, orientations_quat_wxyz=np.roll(t.orientations_quat_wxyz, 1, axis=1)), "order w x y z"),
        (lambda t: replace(t, orientations_quat_wxyz=np.roll(t.orientations_quat_wxyz, -1, axis=1)), "order x y z w"),
        (lambda t: Trajectory.from_poses_se3(t.timestamps_s, np.linalg.inv(t.poses_se3)), "world-to-camera"),
        (lambda t: turned(t, right=MOUNT), "120 degrees in the frame of the camera"),
        (lambda t: turned(t, left=MOUNT), "120 degrees in the frame of the world"),
        (lambda t: turned(t, lever=(0.11, 0, 0)), "constant 0.11 m from the estimate, in the frame of the camera"),
        (
            lambda t: replace(t, positions_xyz=t.positions_xyz + np.array([3, 4, 0])),
            "constant 5 m from the estimate, in the fra",
        ),
    ],
)
def test_ground_truth_error_names_its_cause(estimate, truth, changed, told):
    doubts = doubt_truth(estimate, changed(truth))
    assert any(told in reason for reason in doubts.reasons)
    assert not doubts.positions_only


@pytest.mark.parametrize("name", ["forward-left-up", "forward-right-down", "right-up-back", "down-left-forward"])
def test_the_axes_of_another_body_are_named(estimate, truth, name):
    body = Rotation.from_matrix(parse_axes(name))
    assert f"as of {describe_axes(parse_axes(name))}" in doubt_truth(estimate, turned(truth, right=body)).reasons[0]


def test_stale_ground_truth_poses_are_reported(estimate, truth):
    """They repeat while the estimate moves."""
    rows = np.arange(N)
    rows[100:120], rows[300:303], rows[400:402] = 100, 300, 400
    held = replace(
        truth, positions_xyz=truth.positions_xyz[rows], orientations_quat_wxyz=truth.orientations_quat_wxyz[rows]
    )
    told = [reason for reason in doubt_truth(estimate, held).reasons if "repeat the one before" in reason]
    assert len(told) == 1
    assert "it: 22 of 600 poses (4 %)" in told[0]
    assert "3 stretches: 1.9 s from 10.000, 0.2 s from 30.000, 0.1 s from 40.000" in told[0]
    still = replace(estimate[rows], timestamps_s=truth.timestamps_s)  # rests as well
    assert not any("repeat" in reason for reason in doubt_truth(still, held).reasons)


@pytest.mark.parametrize("shift_s", [18.0, -1.0, 37.3])
def test_clock_offset_is_reported(estimate, truth, shift_s):
    told = describe_time_offset(estimate, replace(truth, timestamps_s=truth.timestamps_s + shift_s))
    assert f"{abs(shift_s):.3g} s {'ahead' if shift_s > 0 else 'behind'}" in told
    assert f"--time-offset {-shift_s:.3g}" in told


def test_turned_world_is_reported_for_level_turns(truth):
    """Nearly all turns are about the vertical axis."""
    sway = Rotation.from_rotvec(np.random.default_rng(2).normal(scale=0.05, size=(N, 3)))
    turns = Rotation.from_rotvec(np.linspace(0, 7, N)[:, None] * [0, 0, 1]) * sway
    estimate = replace(truth, orientations_quat_wxyz=turns.as_quat(scalar_first=True))
    north = Rotation.from_euler("z", 90, degrees=True)
    assert "frame of the world" in doubt_truth(estimate, turned(estimate, left=north)).reasons[0]
