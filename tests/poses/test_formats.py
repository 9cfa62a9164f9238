import pytest

from conformodal.poses import read_tum


@pytest.mark.parametrize("row", ["2 0 0 0 0 0 0 0", "2 nan 0 0 0 0 0 1", "2 1e99 0 0 0 0 0 1", "2 lost"])
def test_a_tum_row_without_a_pose_is_left_out_with_a_warning(tmp_path, row):
    (tmp_path / "file").write_text(f"timestamp tx ty tz qx qy qz qw\n1 5 0 0 0 0 0 1\n{row}\n3 6 0 0 0 0 0 1\n")
    with pytest.warns(UserWarning, match="1 x left out, pose cannot be used: .*file"):
        found = read_tum(tmp_path / "file")
    assert found.timestamps_s.tolist() == [1, 3]
