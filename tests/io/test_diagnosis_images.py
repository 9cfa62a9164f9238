"""What images tell of poses and focal lengths, on real data."""

import re
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import Trajectory, poses_at
from conformodal.io import Recording, read_image, read_recording
from conformodal.io.check import check_recording
from conformodal.io.diagnosis import axes, images
from conformodal.io.diagnosis.cameras import UNLIKELY_CAMERA, doubt_camera
from conformodal.io.diagnosis.images import diagnose_poses
from conformodal.io.diagnosis.order import diagnose
from conformodal.io.layouts.nerf import OPENGL_AXES
from conformodal.io.reading import Note

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
_match_pairs = images._match_pairs
_matched = {}


@pytest.fixture(autouse=True)
def images_are_matched_once(monkeypatch):
    def match(recording):
        key = recording.image_paths, tuple(recording.posed)
        if key not in _matched:
            _matched[key] = _match_pairs(recording)
        return _matched[key]

    monkeypatch.setattr(images, "_match_pairs", match)


def reordered(poses, scalar_first):
    """Poses whose quaternions were written with the scalar first, or last, and read the other way."""
    changed = poses.copy()
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=scalar_first)
    changed[:, :3, :3] = Rotation.from_quat(quats, scalar_first=not scalar_first).as_matrix()
    return changed


RECORDINGS = ["7scenes/redkitchen/seq-01", "tum/fr1_desk", "tum/fr1_xyz", "tum/fr1_rpy", "tum/fr3_cabinet"]
RECORDINGS += ["icl_living_room", "kitti/sequences/06"]


@pytest.mark.parametrize("data", RECORDINGS)
def test_sound_poses_are_not_doubted(real_data, data):
    assert diagnose_poses(read_recording(real_data(*data.split("/")))) is None


def changed(recording, change):
    """The recording with other poses, (n, 4, 4)."""
    poses = Trajectory.from_poses_se3(recording.timestamps_s, change(recording.require_truth().poses_se3))
    return replace(recording, poses=poses)


def bodies(poses, columns):
    """Poses of bodies of these axes (3, 3), and for left-handed ones of a mirrored world."""
    change = np.eye(4)
    change[:3, :3] = columns
    return poses @ change if np.linalg.det(columns) > 0 else change.T @ poses @ change


AXES = [*axes.signed_permutations(proper=True), *axes.signed_permutations(proper=False)]
# each on one recording; on fr1_rpy, whose images are blurred, each takes seconds: five of them
NAMED = {"tum/fr1_desk": AXES[::2], "icl_living_room": AXES[1::2], "tum/fr1_rpy": AXES[::11]}


@pytest.mark.parametrize("data", NAMED)
def test_all_48_axis_conventions_are_recovered(real_data, data):
    """Each is named, and its conversion restores the poses."""
    recording = read_recording(real_data(*data.split("/")))
    for columns in NAMED[data]:
        name = axes.name_axes(columns)
        given = changed(recording, partial(bodies, columns=columns))
        cause = diagnose_poses(given)
        assert (cause is None) == (name == axes.OPENCV)
        assert cause is None or (axes.describe_axes(columns) in cause.what and cause.remedy)
        restored = axes.convert_poses(given.poses, name).poses_se3
        np.testing.assert_allclose(restored, recording.require_truth().poses_se3, atol=1e-9)


def test_ambiguous_axes_report_names_the_choice(real_data):
    """On a straight road several fit alike."""
    recording = read_recording(real_data("kitti", "sequences", "06"))
    of_ros = changed(recording, partial(bodies, columns=axes.parse_axes("flu")))
    told = diagnose_poses(of_ros).what
    first, chosen = re.search(
        r"they fit with (.+?) or .*; (.+) is the most usual of \d+ that fit alike$", told
    ).groups()
    assert first == chosen


WHOLE = {
    "as they are": (lambda image: image, None),
    "turned by 90 degrees clockwise": (lambda image: np.rot90(image, -1), (1, 0)),
    "turned by 90 degrees counterclockwise": (np.rot90, (1, 0)),
    "turned by 180 degrees": (lambda image: image[::-1, ::-1], (0, 1)),
    "mirrored left to right": (lambda image: image[:, ::-1], (0, 1)),
    "flipped top to bottom": (lambda image: image[::-1], (0, 1)),
    "clockwise and then mirrored": (lambda image: np.rot90(image, -1)[:, ::-1], (1, 0)),
}


class ChangedImages(Recording):
    """A recording whose pictures are turned or mirrored; its camera stays where it may."""

    def image(self, i):
        return np.ascontiguousarray(WHOLE[self.name][0](super().image(i)))


@pytest.mark.parametrize("told", WHOLE)
@pytest.mark.parametrize("of_these_images", [True, False])
def test_turned_and_mirrored_images_are_named(real_data, told, of_these_images, monkeypatch):
    recording = read_recording(real_data("tum", "fr1_desk"))
    camera, order = recording.camera, WHOLE[told][1] or (0, 1)
    size = np.array([camera.width, camera.height])[list(order)]
    middle = np.array([camera.cx, camera.cy])[list(order if of_these_images else (0, 1))]
    lens = replace(camera, width=int(size[0]), height=int(size[1]), cx=middle[0], cy=middle[1], distortion=())
    fields = {field.name: getattr(recording, field.name) for field in dataclass_fields(recording)}
    made = ChangedImages(**fields | {"name": told, "camera": lens})
    monkeypatch.setattr(Recording, "image", lambda self, i: read_image(self.image_paths[i]))
    monkeypatch.setattr(images, "_match_pairs", _match_pairs)
    cause = diagnose_poses(made)
    if told == "as they are":
        assert cause is None
        return
    assert told in cause.what
    assert ("middle of the images" in cause.what) == (order == (1, 0) and not of_these_images)


@pytest.mark.parametrize("world_axes", ["y,x,-z", "x,-z,y", "z,x,y", "x,y,-z", "-x,y,z"])
@pytest.mark.parametrize(("body", "inverse"), [(axes.OPENCV, False), ("forward-right-down", True)])
def test_positions_of_another_world_than_orientations_are_named(real_data, world_axes, body, inverse):
    recording = read_recording(real_data("7scenes", "redkitchen", "seq-01"))
    turn = axes.parse_world_axes(world_axes)

    def written(poses):
        poses = bodies(poses, axes.parse_axes(body))
        poses[:, :3, 3] = poses[:, :3, 3] @ turn
        return np.linalg.inv(poses) if inverse else poses

    given = changed(recording, written)
    cause = diagnose_poses(given)
    for named in (f"--world-axes {world_axes}", *([f"--axes {body}"] if body != axes.OPENCV else [])):
        assert named in cause.remedy
    assert ("--world-to-camera" in cause.remedy) == inverse
    restored = axes.convert_poses(given.poses, body, world_axes, world_to_camera=inverse).poses_se3
    np.testing.assert_allclose(restored, recording.require_truth().poses_se3, atol=1e-9)


@pytest.mark.parametrize("data", ["7scenes/redkitchen/seq-01", "tum/fr1_xyz"])
def test_pose_convention_is_named(real_data, data):
    recording = read_recording(real_data(*data.split("/")))
    inverse = np.linalg.inv
    made = {
        "world-to-camera poses": inverse,
        "world-to-camera poses and axes right-up-back (OpenGL)": lambda poses: inverse(poses @ OPENGL_AXES),
        "quaternions wxyz": lambda poses: reordered(poses, True),
        "world-to-camera quaternions wxyz": lambda poses: reordered(inverse(poses), True),
        "quaternions xyzw of COLMAP's world-to-camera poses": lambda poses: inverse(reordered(inverse(poses), False)),
    }
    for best, change in made.items():  # whatever they were made to be, what undoes it is named
        assert f"they fit with {best}, where" in diagnose_poses(changed(recording, change)).what


@pytest.mark.parametrize("part", ["positions_xyz", "orientations_quat_wxyz"])
@pytest.mark.parametrize(("every", "share"), [(3, 66), (30, 96)])
def test_positions_or_orientations_of_a_lower_rate_are_named(real_data, part, every, share):
    recording = read_recording(real_data("tum", "fr1_desk"))
    rows = np.arange(len(recording)) // every * every
    poses = replace(recording.poses, **{part: getattr(recording.poses, part)[rows]})
    cause = diagnose_poses(replace(recording, poses=poses))
    assert cause.what.startswith(f"{part.split('_')[0]} repeat to the last bit in {share} % of the poses")


def test_a_camera_that_turns_alone_is_compared_by_its_rotation(real_data):
    recording = read_recording(real_data("tum", "fr1_desk"))
    still = np.tile(recording.poses.positions_xyz[:1], (len(recording), 1))
    assert diagnose_poses(replace(recording, poses=replace(recording.poses, positions_xyz=still))) is not None


def late_by(recording, shift_s):
    """The frames whose poses were recorded by a clock that is ahead."""
    truth = recording.require_truth()
    rows = poses_at(truth, truth.timestamps_s - shift_s, 1.0).rows
    kept = np.isfinite(rows).all(axis=1)
    poses = Trajectory(recording.timestamps_s[kept], rows[kept, :3], rows[kept, 3:])
    return replace(recording, poses=poses)  # the other frames have none


@pytest.mark.parametrize("data", ["7scenes/redkitchen", "tum/fr1_desk"])
@pytest.mark.parametrize("shift_s", [0.1, -1.0])
def test_clock_offset_is_reported(real_data, data, shift_s):
    cause = str(diagnose_poses(late_by(read_recording(real_data(*data.split("/"))), shift_s)))
    told, side = re.search(r"seem to be ([\d.]+) s .* too (late|early)", cause).groups()
    assert float(told) == pytest.approx(abs(shift_s), abs=0.03)
    assert side == ("late" if shift_s > 0 else "early")


def test_pose_rows_shifted_by_lines_are_reported(real_data):
    recording = read_recording(real_data("7scenes", "redkitchen"))
    truth = recording.require_truth()
    rolled = Trajectory(
        truth.timestamps_s, np.roll(truth.positions_xyz, 7, axis=0), np.roll(truth.orientations_quat_wxyz, 7, axis=0)
    )
    told = re.search(r"\(([\d.]+) frames\) too late", str(diagnose_poses(replace(recording, poses=rolled))))
    assert float(told[1]) == pytest.approx(7, abs=0.5)


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_wrong_focal_length_is_reported(real_data, factor):
    recording = read_recording(real_data("tum", "fr1_desk"))
    camera = recording.camera
    cause = str(
        diagnose_poses(replace(recording, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)))
    )
    low, high = map(int, re.search(r"imply a focal length of (\d+) to (\d+) px", cause).groups())
    assert 0.9 * camera.fx < low < camera.fx < high < 1.1 * camera.fx


def test_poses_of_other_images_are_reported(real_data):
    recording = read_recording(real_data("tum", "fr1_desk"))
    truth = recording.require_truth()
    backwards = Trajectory(truth.timestamps_s, truth.positions_xyz[::-1], truth.orientations_quat_wxyz[::-1])
    assert "belong to other images" in diagnose_poses(replace(recording, poses=backwards)).what


def test_an_unlikely_camera_explains_poses_that_do_not_fit(real_data):
    recording = read_recording(real_data("tum", "fr1_desk"))
    camera = recording.camera
    half = replace(camera, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2, distortion=())
    doubt = doubt_camera(half).unlikely[0]
    given = replace(recording, camera=half, notes=(Note(UNLIKELY_CAMERA, f"K.txt: {doubt}"),))
    cause = diagnose(given)
    assert cause.what == f"the camera is unlikely: K.txt: {doubt}"
    assert "epipolar" in cause.evidence
    findings = [finding.what for finding in check_recording(given).findings if finding.wrong]
    assert findings == [UNLIKELY_CAMERA]  # one cause
    assert diagnose(replace(given, camera=camera)) is None
