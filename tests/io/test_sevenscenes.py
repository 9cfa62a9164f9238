import numpy as np
import pytest
from PIL import Image

from conformodal.io import DatasetError, read_recording
from conformodal.io.check import check_recording


def write_recording(folder, n=4, suffix="png", size=(32, 24)):
    folder.mkdir(parents=True)
    (folder / "camera-intrinsics.txt").write_text("30 0 16\n0 30 12\n0 0 1\n")
    for i in range(n):
        Image.new("RGB", size, (i, 0, 0)).save(folder / f"frame-{i:06d}.color.{suffix}")
        pose = np.eye(4)
        pose[:3, 3] = i, 2 * i, 3 * i
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    return folder


def test_scene_of_several_recordings_is_kept_apart(tmp_path):
    write_recording(tmp_path / "seq-01")
    write_recording(tmp_path / "seq-02", n=3)
    (tmp_path / "frame-rate.txt").write_text("10\n")
    sequence = read_recording(tmp_path)
    assert sequence.recording.tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert sequence.timestamps_s[1] == pytest.approx(0.1)
    assert (np.diff(sequence.timestamps_s) > 0).all()


def test_default_camera_is_reported(tmp_path):
    folder = write_recording(tmp_path / "seq-01", size=(640, 480))
    (folder / "camera-intrinsics.txt").unlink()
    sequence = read_recording(folder)
    assert sequence.camera.fx == 585
    assert "its focal length is 585 pixels" in dict(sequence.notes)["the camera is the layout's"]
    assert not any(finding.wrong for finding in check_recording(sequence).findings if "layout" in finding.what)


def write_scene(folder, train="sequence1\n", test="sequence2\nsequence3\n"):
    for number in (1, 2, 3):
        write_recording(folder / f"seq-{number:02d}", n=number)
    (folder / "TrainSplit.txt").write_text(train)
    (folder / "TestSplit.txt").write_text(test)
    return folder


@pytest.mark.parametrize(
    ("train", "test", "expected"),
    [
        ("sequence1\n", "sequence2\nsequence3\n", [0, 1, 1, 1, 1, 1]),
        ("sequence 3\r\nSequence1\r\n\r\n", "sequence02", [0, 1, 1, 0, 0, 0]),
    ],
)
def test_lists_of_a_scene_say_which_frames_test(tmp_path, train, test, expected):
    sequence = read_recording(write_scene(tmp_path, train, test))
    assert sequence.given_test.dtype == bool
    assert sequence.given_test.tolist() == [bool(x) for x in expected]
    assert read_recording(tmp_path / "seq-01").given_test is None


@pytest.mark.parametrize(
    ("train", "test", "match"),
    [
        ("sequence1\n", "sequence2\n\nsequence3\nsequence7\n", r"TestSplit\.txt \[2, 3, 7\]"),
        ("sequence1\n", "sequence2\n", r"each of the folders \[1, 2, 3\] once"),
        ("sequence1\nall the rest\n", "sequence2\n", r"TrainSplit\.txt, line 2"),
        ("sequence1\nsequence2\nsequence3\n", "", r"TestSplit\.txt: holds no line"),
    ],
)
def test_inconsistent_split_lists_are_refused(tmp_path, train, test, match):
    """They must name every recording once; the error names the file, and the line if one is wrong."""
    with pytest.raises(DatasetError, match=match):
        read_recording(write_scene(tmp_path, train, test))
