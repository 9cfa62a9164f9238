import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import (
    PinholeCamera,
    PoseError,
    Trajectory,
    TrajectoryFileError,
    angle_between_quats,
    associate,
    fix_sign,
    read_tum,
    sign_reference,
    trajectory_errors,
    write_tum,
)
from conformodal.poses.rotations import check_rotation_matrices


def random_trajectory(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return Trajectory(np.arange(n) / 10, rng.normal(size=(n, 3)), rng.normal(size=(n, 4)))


def test_poses_round_trip_through_matrices():
    t = random_trajectory()
    back = Trajectory.from_poses_se3(t.timestamps_s, t.poses_se3)
    np.testing.assert_allclose(back.positions_xyz, t.positions_xyz)
    np.testing.assert_allclose(angle_between_quats(back.orientations_quat_wxyz, t.orientations_quat_wxyz), 0, atol=1e-7)


def test_quaternions_are_wxyz_and_rotate_camera_to_world():
    turn_left = np.array([[np.cos(0.25 * np.pi), 0, 0, np.sin(0.25 * np.pi)]])  # 90 degrees about z
    pose = Trajectory(np.zeros(1), np.zeros((1, 3)), turn_left).poses_se3[0]
    np.testing.assert_allclose(pose[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_angles_are_exact_and_blind_to_sign():
    q = Rotation.from_rotvec([[0.3, 0, 0], [1e-9, 0, 0], [np.pi, 0, 0]]).as_quat(scalar_first=True)
    angle = angle_between_quats(np.array([1.0, 0, 0, 0]), q)
    np.testing.assert_allclose(angle, [0.3, 1e-9, np.pi], rtol=1e-6)
    np.testing.assert_allclose(angle_between_quats(-q, q), 0, atol=1e-12)


def test_one_view_has_one_sign_even_after_a_full_turn():
    yaw = np.linspace(0, 2 * np.pi, 50)
    along = np.column_stack((np.cos(yaw / 2), np.zeros((50, 2)), np.sin(yaw / 2)))  # the sign flips on the way
    assert along[0] @ along[-1] < -0.99
    fixed = fix_sign(along, sign_reference(along))
    np.testing.assert_allclose(fixed[0], fixed[-1], atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (np.diag([1.0, 1, -1]), "mirror"),
        (np.eye(3) * 1.1, "not a rotation"),
        (np.full((3, 3), np.nan), "NaN"),
    ],
)
def test_matrices_that_are_no_rotations_are_refused(matrix, match):
    with pytest.raises(PoseError, match=match):
        check_rotation_matrices(np.stack([np.eye(3), matrix]))


def test_tum_round_trip_and_order_of_the_quaternion(tmp_path):
    t = random_trajectory()
    write_tum(tmp_path / "t.tum", t)
    back = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(back.positions_xyz, t.positions_xyz, atol=1e-9)
    np.testing.assert_allclose(back.orientations_quat_wxyz, t.orientations_quat_wxyz, atol=1e-8)
    fields = (tmp_path / "t.tum").read_text().splitlines()[1].split()
    assert float(fields[7]) == pytest.approx(t.orientations_quat_wxyz[0, 0])  # w comes last in the file


@pytest.mark.parametrize(
    "text", ["", "# only a comment\n", "1 2 3\n", "0 0 0 0 0 0 0 nan\n", "0 0 0 0 0 0 0 0\n", "a b c d e f g h\n"]
)
def test_bad_tum_files_are_named(tmp_path, text):
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(TrajectoryFileError, match=r"bad\.tum"):
        read_tum(tmp_path / "bad.tum")
    with pytest.raises(TrajectoryFileError, match="missing"):
        read_tum(tmp_path / "missing.tum")


def test_errors_of_a_known_offset():
    truth = random_trajectory()
    turn = Rotation.from_rotvec([0, 0, np.radians(5)])
    turned = (turn * Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    errors = trajectory_errors(Trajectory(truth.timestamps_s, truth.positions_xyz + np.array([0, 3, 4]), turned), truth)
    assert errors == pytest.approx({"rmse_m": 5, "rmse_deg": 5, "median_m": 5, "median_deg": 5})


@pytest.mark.parametrize(
    ("key", "truth", "estimate"),
    [
        ("fr1_xyz_rgbdslam_drift", "freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam_drift.txt"),
        ("fr2_desk_orb", "fr2_desk_groundtruth.txt", "fr2_desk_ORB.txt"),
    ],
)
def test_unaligned_errors_agree_with_published_ones(real_data, key, truth, estimate):
    reference = json.loads(real_data("trajectories", "reference_metrics.json").read_text())["results"][key]["none"]
    true, guess = (
        read_tum(real_data("trajectories", "evo", truth)),
        read_tum(real_data("trajectories", "evo", estimate)),
    )
    mine, theirs = associate(guess, true)
    errors = trajectory_errors(guess[mine], true[theirs])
    assert errors["rmse_m"] == pytest.approx(reference["ate_trans_m"]["rmse"], rel=1e-6)
    assert errors["median_m"] == pytest.approx(reference["ate_trans_m"]["median"], rel=1e-6)
    assert errors["rmse_deg"] == pytest.approx(reference["ate_rot_deg"]["rmse"], rel=1e-6)


def test_association_pairs_nearest_times():
    truth, estimate = random_trajectory(10), random_trajectory(3)
    shifted = Trajectory(np.array([0.104, 0.35, 0.897]), estimate.positions_xyz, estimate.orientations_quat_wxyz)
    mine, theirs = associate(shifted, truth)
    assert mine.tolist() == [0, 2]
    assert theirs.tolist() == [1, 9]
    late = Trajectory(truth.timestamps_s + 100, truth.positions_xyz, truth.orientations_quat_wxyz)
    with pytest.raises(PoseError, match="no estimated pose"):
        associate(late, truth)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Trajectory(np.zeros(2), np.zeros((3, 3)), np.ones((2, 4))), "positions_xyz"),
        (lambda: Trajectory(np.zeros(1), np.full((1, 3), np.nan), np.ones((1, 4))), "row 0"),
        (lambda: Trajectory(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 4))), "length zero"),
        (lambda: Trajectory.from_poses_se3(np.zeros(1), np.zeros((1, 3, 4))), r"\(n, 4, 4\)"),
        (lambda: trajectory_errors(random_trajectory(3), random_trajectory(4)), "pair them"),
        (lambda: PinholeCamera(-1, 1, 0, 0, 4, 4), "positive"),
    ],
)
def test_bad_input_is_refused(make, match):
    with pytest.raises(PoseError, match=match):
        make()


def test_bearings_of_the_principal_point_look_forward():
    camera = PinholeCamera(100, 120, 32, 24, 64, 48)
    rays = camera.bearings(np.array([[32.0, 24.0], [132.0, 24.0], [32.0, 144.0]]))
    np.testing.assert_allclose(rays, [[0, 0, 1], [2**-0.5, 0, 2**-0.5], [0, 2**-0.5, 2**-0.5]], atol=1e-12)
