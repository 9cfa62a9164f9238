"""What images tell of poses and focal lengths, on real data."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory, poses_at
from conformodal.io import convention, read_recording
from conformodal.io.convention import doubt_poses
from conformodal.io.layouts.nerf import OPENGL_AXES

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
_match_pairs = convention._match_pairs
_matched = {}
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])  # y up becomes y down


@pytest.fixture(autouse=True)
def images_are_matched_once(monkeypatch):
    def match(recording):
        key = recording.image_paths, tuple(recording.posed)
        if key not in _matched:
            _matched[key] = _match_pairs(recording)
        return _matched[key]

    monkeypatch.setattr(convention, "_match_pairs", match)


def reordered(poses, scalar_first):
    """Poses whose quaternions were written with the scalar first, or last, and read the other way."""
    changed = poses.copy()
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=scalar_first)
    changed[:, :3, :3] = Rotation.from_quat(quats, scalar_first=not scalar_first).as_matrix()
    return changed


@pytest.mark.parametrize("data", ["7scenes/redkitchen", "tum/fr1_xyz"])
def test_the_convention_of_given_poses_is_told(real_data, data):
    recording = read_recording(real_data(*data.split("/")))
    assert doubt_poses(recording) == ""
    given = recording.require_truth().poses_se3
    inverse = np.linalg.inv
    made = {
        "world-to-camera, OpenCV axes": inverse(given),
        "camera-to-world, OpenGL axes": given @ OPENGL_AXES,
        "world-to-camera, OpenGL axes": inverse(given @ OPENGL_AXES),
        "camera-to-world, left-handed axes with y up (Unity)": MIRRORED @ given @ MIRRORED,
        "those of a body with x forward and z up (ROS)": given @ convention._OF_BODY.T,
        "quaternions wxyz": reordered(given, True),
        "quaternions wxyz, world-to-camera": reordered(inverse(given), True),
        "quaternions xyzw, as COLMAP's world-to-camera": inverse(reordered(inverse(given), False)),
    }
    for best, poses in made.items():  # whatever they were made to be, what undoes it is named
        changed = replace(recording, poses=Trajectory.from_poses_se3(recording.timestamps_s, poses))
        assert f"poses fit the images as {best}, and are read as" in doubt_poses(changed)


def late_by(recording, shift_s):
    """The frames whose poses were recorded by a clock that is ahead."""
    truth = recording.require_truth()
    rows = poses_at(truth, truth.timestamps_s - shift_s, 1.0).rows
    kept = np.isfinite(rows).all(axis=1)
    poses = Trajectory(recording.timestamps_s[kept], rows[kept, :3], rows[kept, 3:])
    return replace(recording, poses=poses)  # the other frames have none


@pytest.mark.parametrize("data", ["7scenes/redkitchen", "tum/fr1_desk"])
@pytest.mark.parametrize("shift_s", [0.1, -1.0])
def test_poses_of_another_clock_are_told_with_the_shift(real_data, data, shift_s):
    cause = doubt_poses(late_by(read_recording(real_data(*data.split("/"))), shift_s))
    told, side = re.search(r"seem to be ([\d.]+) s .* too (late|early)", cause).groups()
    assert float(told) == pytest.approx(abs(shift_s), abs=0.03)
    assert side == ("late" if shift_s > 0 else "early")


def test_poses_that_are_shifted_by_lines_are_told(real_data):
    recording = read_recording(real_data("7scenes", "redkitchen"))
    truth = recording.require_truth()
    rolled = Trajectory(
        truth.timestamps_s, np.roll(truth.positions_xyz, 7, axis=0), np.roll(truth.orientations_quat_wxyz, 7, axis=0)
    )
    told = re.search(r"\(([\d.]+) frames\) too late", doubt_poses(replace(recording, poses=rolled)))
    assert float(told[1]) == pytest.approx(7, abs=0.5)


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_another_focal_length_is_told(real_data, factor):
    recording = read_recording(real_data("tum", "fr1_desk"))
    camera = recording.camera
    cause = doubt_poses(replace(recording, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)))
    low, high = map(int, re.search(r"imply a focal length of (\d+) to (\d+) px", cause).groups())
    assert 0.9 * camera.fx < low < camera.fx < high < 1.1 * camera.fx


def test_poses_of_other_images_are_told_without_blame(real_data):
    recording = read_recording(real_data("tum", "fr1_desk"))
    truth = recording.require_truth()
    backwards = Trajectory(truth.timestamps_s, truth.positions_xyz[::-1], truth.orientations_quat_wxyz[::-1])
    assert "belong to other images" in doubt_poses(replace(recording, poses=backwards))
