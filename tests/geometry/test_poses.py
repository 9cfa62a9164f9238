import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import (
    PinholeCamera,
    PoseError,
    Trajectory,
    angle_between_quats,
    fix_sign,
    matrix_from_quat_wxyz,
    sign_reference,
    trajectory_errors,
)
from conformodal.geometry.poses import check_rotation_matrices
from conformodal.io.layouts.kitti import RATE_HZ, kitti_table
from conformodal.io.pose_files import euroc_table, read_tum


def random_trajectory(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return Trajectory(np.arange(n) / 10, rng.normal(size=(n, 3)), rng.normal(size=(n, 4)))


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
    [(np.diag([1.0, 1, -1]), "mirror"), (np.eye(3) * 1.1, "not a rotation"), (np.full((3, 3), np.nan), "NaN")],
)
def test_matrices_that_are_no_rotations_are_refused(matrix, match):
    with pytest.raises(PoseError, match=match):
        check_rotation_matrices(np.stack([np.eye(3), matrix]))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Trajectory(np.zeros(2), np.zeros((3, 3)), np.ones((2, 4))), "positions_xyz"),
        (lambda: Trajectory(np.zeros(1), np.full((1, 3), np.nan), np.ones((1, 4))), "row 0"),
        (lambda: Trajectory(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 4))), "length zero"),
        (lambda: Trajectory([0.0, np.nan], np.zeros((2, 3)), np.ones((2, 4))), "timestamps_s must be finite"),
        (lambda: Trajectory(np.zeros((2, 1)), np.zeros((2, 3)), np.ones((2, 4))), "timestamps_s must be finite"),
        (lambda: matrix_from_quat_wxyz(np.zeros((2, 4))), "quaternions are not rotations"),
        (lambda: Trajectory.from_poses_se3(np.zeros(1), np.zeros((1, 3, 4))), r"\(n, 4, 4\)"),
        (lambda: trajectory_errors(random_trajectory(3), random_trajectory(4)), "pair them"),
        (lambda: PinholeCamera(-1, 1, 0, 0, 4, 4), "positive"),
    ],
)
def test_bad_input_is_refused(make, match):
    with pytest.raises(PoseError, match=match):
        make()


def read_kitti(file):
    rows = kitti_table(file).rows
    return Trajectory(np.arange(len(rows)) / RATE_HZ, rows[:, :3], rows[:, 3:])


def read_euroc(file):
    rows = euroc_table(file).rows
    return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])


FORMATS = {"tum": read_tum, "kitti": read_kitti, "euroc": read_euroc}


def test_conventions_of_the_files_are_the_published_ones(tmp_path):
    """A camera at (1, 2, 3) that was turned a quarter about z."""
    half = np.sqrt(0.5)
    (tmp_path / "kitti").write_text("0 -1 0 1 1 0 0 2 0 0 1 3\n")
    (tmp_path / "tum").write_text(f"5 1 2 3 0 0 {half} {half}\n")
    (tmp_path / "euroc").write_text(f"#timestamp\n5000000000,1,2,3,{half},0,0,{half},9,9,9\n")
    for name, read in FORMATS.items():
        pose = read(tmp_path / name)
        np.testing.assert_allclose(
            pose.poses_se3[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
        )
        assert pose.timestamps_s[0] == (0 if name == "kitti" else 5)


@pytest.mark.parametrize("row", ["2 0 0 0 0 0 0 0", "2 nan 0 0 0 0 0 1", "2 1e99 0 0 0 0 0 1"])
def test_a_tum_row_without_a_pose_is_left_out_with_a_warning(tmp_path, row):
    (tmp_path / "file").write_text(f"timestamp tx ty tz qx qy qz qw\n1 5 0 0 0 0 0 1\n{row}\n3 6 0 0 0 0 0 1\n")
    with pytest.warns(UserWarning, match="1 x left out, pose cannot be used: .*file"):
        found = read_tum(tmp_path / "file")
    assert found.timestamps_s.tolist() == [1, 3]
