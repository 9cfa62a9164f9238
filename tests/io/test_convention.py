"""What images tell of poses and focal lengths, on real data."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory
from conformodal.io import DatasetError, read_recording
from conformodal.io.convention import FITTED, fitting_convention, with_fitted_focal
from conformodal.io.layouts.nerf import OPENGL_AXES

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])  # y up becomes y down


def reordered(poses, scalar_first):
    """Poses whose quaternions were written with the scalar first, or last, and read the other way."""
    changed = poses.copy()
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=scalar_first)
    changed[:, :3, :3] = Rotation.from_quat(quats, scalar_first=not scalar_first).as_matrix()
    return changed


@pytest.mark.parametrize("data", ["7scenes/redkitchen", "tum/fr1_xyz"])
def test_the_convention_of_given_poses_is_told(real_data, data):
    recording = read_recording(real_data(*data.split("/")))
    given = recording.require_truth().poses_se3
    inverse = np.linalg.inv
    made = {
        "camera-to-world, OpenCV axes": given,
        "world-to-camera, OpenCV axes": inverse(given),
        "camera-to-world, OpenGL axes": given @ OPENGL_AXES,
        "world-to-camera, OpenGL axes": inverse(given @ OPENGL_AXES),
        "camera-to-world, left-handed axes with y up (Unity)": MIRRORED @ given @ MIRRORED,
        "quaternions wxyz": reordered(given, True),
        "quaternions wxyz, world-to-camera": reordered(inverse(given), True),
        "quaternions xyzw, as COLMAP's world-to-camera": inverse(reordered(inverse(given), False)),
    }
    for best, poses in made.items():  # whatever they were made to be, what undoes it is named
        changed = replace(recording, poses=Trajectory.from_poses_se3(recording.timestamps_s, poses))
        assert fitting_convention(changed)[0] == best


def without_lens(recording):
    camera = recording.camera
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    return replace(recording, camera=replace(camera, fx=100.0, fy=100.0, distortion=(), **middle))


@pytest.mark.parametrize(("folder", "focal"), [("7scenes/redkitchen", 525.5), ("tum/fr1_xyz", 516.9)])
def test_a_fitted_focal_length_lies_in_its_range(real_data, folder, focal):
    """Of redkitchen, the published truth by COLMAP; of TUM's first camera, whose lens is not modelled, its makers'."""
    fitted = with_fitted_focal(without_lens(read_recording(real_data(*folder.split("/")))))
    low, high = map(int, re.search(r"between (\d+) and (\d+)", dict(fitted.notes)[FITTED]).groups())
    assert low < focal < high < 1.25 * low
    assert fitted.camera.fx == pytest.approx(focal, rel=0.06)


def test_a_camera_that_hardly_turns_does_not_show_its_focal_length(real_data):
    with pytest.raises(DatasetError, match=r"turns by 0\.1\d degrees"):
        with_fitted_focal(without_lens(read_recording(real_data("kitti", "sequences", "06"))))
