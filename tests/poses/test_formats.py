import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.poses import Trajectory, TrajectoryFileError, read_euroc, read_kitti, read_tum, write_tum


def some_path(n=6, start_s=0.0):
    rng = np.random.default_rng(0)
    times = start_s + np.arange(n) / 10
    return Trajectory(times, rng.normal(size=(n, 3)) * 100, Rotation.random(n, rng).as_quat(scalar_first=True))


def write_kitti(file, path):
    np.savetxt(file, path.poses_se3[:, :3].reshape(-1, 12))


def write_euroc(file, path):
    rows = zip(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz, strict=True)
    file.write_text("#h\n" + "".join(f"{round(t * 1e9)},{','.join(map(str, (*p, *q)))}\n" for t, p, q in rows))


FORMATS = {"tum": (read_tum, write_tum), "kitti": (read_kitti, write_kitti), "euroc": (read_euroc, write_euroc)}


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written_is_read_back(tmp_path, name):
    read, write = FORMATS[name]
    path = some_path(start_s=0.0 if name == "kitti" else 1_403_636_579.7)
    write(tmp_path / "file", path)
    back = read(tmp_path / "file")
    np.testing.assert_allclose(back.positions_xyz, path.positions_xyz, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(back.orientations_quat_wxyz * path.orientations_quat_wxyz, axis=1)), 1)
    np.testing.assert_allclose(back.timestamps_s, path.timestamps_s, atol=1e-6)


def test_conventions_of_the_files_are_the_published_ones(tmp_path):
    """A camera at (1, 2, 3) that was turned a quarter about z."""
    half = np.sqrt(0.5)
    (tmp_path / "kitti").write_text("0 -1 0 1 1 0 0 2 0 0 1 3\n")
    (tmp_path / "tum").write_text(f"5 1 2 3 0 0 {half} {half}\n")
    (tmp_path / "euroc").write_text(f"#timestamp\n5000000000,1,2,3,{half},0,0,{half},9,9,9\n")
    for name, (read, _) in FORMATS.items():
        pose = read(tmp_path / name)
        np.testing.assert_allclose(
            pose.poses_se3[0], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12
        )
        assert pose.timestamps_s[0] == (0 if name == "kitti" else 5)


def test_real_kitti_poses_are_read(real_data):
    path = read_kitti(real_data("trajectories", "kitti", "00.txt"))
    assert len(path) == 4541
    assert path.timestamps_s[1] == pytest.approx(0.1)
    np.testing.assert_allclose(path.positions_xyz[0], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("read", "content", "match"),
    [
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 1\n", "line 1.*twelve"),
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 1 x\n", "line 1.*twelve"),
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 1 nan\n", "line 1.*twelve"),
        (read_kitti, "\n\n", "holds no pose"),
        (read_kitti, "2 0 0 0 0 1 0 0 0 0 1 0\n", "not a rotation"),
        (read_euroc, "#h\n1.5,0,0,0,1,0,0,0\n", "line 2.*ns"),
        (read_euroc, "1,0,0,0,1,0,0\n", "line 1.*qw"),
        (read_euroc, "1,0,0,0,inf,0,0,0\n", "line 1.*qw"),
        (read_euroc, "#h\n", "holds no pose"),
        (read_euroc, "1,0,0,0,0,0,0,0\n", "file"),
        *[
            (read, content, "file")
            for read in (read_tum, read_kitti, read_euroc)
            for content in ("", "1 2 3\n", "nan " * 12, "1e400 " * 8, "1_0 " * 8, "\0" * 99)
        ],
    ],
)
def test_damaged_files_are_named(tmp_path, read, content, match):
    (tmp_path / "file").write_text(content)
    with pytest.raises(TrajectoryFileError, match=match):
        read(tmp_path / "file")
    with pytest.raises(TrajectoryFileError, match="cannot be read"):
        read(tmp_path / "missing")


@pytest.mark.parametrize("row", ["2 0 0 0 0 0 0 0", "2 nan 0 0 0 0 0 1", "2 1e99 0 0 0 0 0 1", "2 lost"])
def test_a_tum_row_without_a_pose_is_left_out_with_a_warning(tmp_path, row):
    (tmp_path / "file").write_text(f"timestamp tx ty tz qx qy qz qw\n1 5 0 0 0 0 0 1\n{row}\n3 6 0 0 0 0 0 1\n")
    with pytest.warns(UserWarning, match="1 x left out, pose cannot be used: .*file"):
        found = read_tum(tmp_path / "file")
    assert found.timestamps_s.tolist() == [1, 3]
