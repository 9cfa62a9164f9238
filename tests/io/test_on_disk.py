"""What public bug reports of readers brought: each kind with the right value."""

import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import DatasetError, DatasetWarning, read_recording
from conformodal.io.convention import fitting_convention
from conformodal.io.layouts.nerf import OPENGL_AXES
from conformodal.io.lenses import as_camera

from .test_layouts import PLACES, QUATS, WRITERS, Layout, N, as_binary, matrices, picture

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")

MIRRORED = np.diag([1.0, -1.0, 1.0, 1.0])  # y up becomes y down


def nerf(root, *, name="transforms.json", top=None, frames=None):
    """A NeRF data set, changed on top and in its frames."""
    WRITERS[Layout.NERF](root)
    content = json.loads((root / "transforms.json").read_text())
    (root / "transforms.json").unlink()
    content["frames"].reverse()  # in the order of names
    for frame, change in zip(content["frames"], frames or [{}] * N, strict=True):
        frame.update(change)
    content = {k: v for k, v in (content | (top or {})).items() if v is not None}
    (root / name).write_text(json.dumps(content))
    return root


def test_the_vertical_angle_of_a_nerf_file_is_used(tmp_path):
    angles = {"camera_angle_x": 2 * np.arctan(32 / 40), "camera_angle_y": 2 * np.arctan(24 / 44)}
    camera = read_recording(nerf(tmp_path, top=angles)).camera
    assert (camera.fx, camera.fy) == pytest.approx((40, 44))


@pytest.mark.parametrize("second", ["images/0000.png", "images/../images/0000", "./images//0000"])
def test_one_image_by_two_names_is_refused(tmp_path, second):
    frames = [{}, {"file_path": second}, {}, {}, {}]
    with pytest.raises(DatasetError, match="twice"):
        read_recording(nerf(tmp_path, frames=frames))


def test_equal_cameras_in_every_frame_and_none_on_top_are_one(tmp_path):
    own = {"fl_x": 40.0, "fl_y": 41.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    top = dict.fromkeys(("camera_angle_x", "cx", "cy"))
    sequence = read_recording(nerf(tmp_path, top=top, frames=[own] * N))
    assert (sequence.camera.fx, sequence.camera.fy) == (40, 41)
    assert all(path.parent == tmp_path / "images" for path in sequence.image_paths)


def test_the_training_frames_alone_are_read_and_the_others_named(tmp_path):
    nerf(tmp_path, name="transforms_train.json")
    (tmp_path / "transforms_test.json").write_text("{}")
    with pytest.warns(DatasetWarning, match=r"transforms_test\.json beside it are not"):
        sequence = read_recording(tmp_path)
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-9)


def test_what_nerfstudio_applied_to_the_world_is_undone(tmp_path):
    applied = np.array([[1.0, 0, 0, 0.3], [0, 0, 1, -0.2], [0, -1, 0, 0.1]])
    opengl = matrices() * np.array([1.0, -1, -1, 1])
    moved = np.vstack((applied, [0, 0, 0, 1])) @ opengl
    moved[:, :3, 3] *= 0.25
    frames = [{"transform_matrix": pose.tolist()} for pose in moved]
    top = {"applied_transform": applied.tolist(), "applied_scale": 0.25}
    np.testing.assert_allclose(
        read_recording(nerf(tmp_path, top=top, frames=frames)).truth.poses_se3, matrices(), atol=1e-9
    )
    with pytest.raises(DatasetError, match="applied_transform"):
        read_recording(nerf(tmp_path / "b", top={"applied_transform": (-applied).tolist()}))


def tum(root, rows, stamps, header=()):
    """A TUM data set with another pose file."""
    folder = WRITERS[Layout.TUM](root)
    lines = [" ".join(map(repr, [t, *row])) for t, row in zip(stamps.tolist(), rows.tolist(), strict=True)]
    (folder / "groundtruth.txt").write_text("\n".join([*header, *lines]) + "\n")
    return folder


def path_at(times):
    """The path of the known scene at other times: 5 m/s along x, 100 degrees per second to the left."""
    turned = Rotation.from_euler("z", (100 * (times - 100))[:, None], degrees=True)
    first = Rotation.from_quat(QUATS[0], scalar_first=True)
    quats = (turned * first).as_quat()
    return np.column_stack((5 * (times - 100), np.zeros(len(times)), np.full(len(times), 1.5), quats))


@pytest.mark.parametrize(("rate", "shift"), [(10, 0.004), (10, 0.05), (100, 0.003), (15, 0.0)])
def test_poses_at_another_rate_are_interpolated(tmp_path, rate, shift):
    stamps = 99.9 + shift + np.arange(8 * rate // 10) / rate
    sequence = read_recording(tum(tmp_path, path_at(stamps), stamps))
    assert len(sequence) == N
    np.testing.assert_allclose(sequence.truth.positions_xyz, PLACES, atol=1e-9)
    np.testing.assert_allclose(sequence.truth.poses_se3[:, :3, :3], matrices()[:, :3, :3], atol=1e-9)
    assert any(f"gap bridged is {1 / rate:.3g} s" in where for _, where in sequence.notes) or shift == 0.0


def test_the_gap_that_is_bridged_has_a_limit_that_a_file_sets(tmp_path):
    stamps = 99.9 + 0.3 * np.arange(4)
    folder = tum(tmp_path, path_at(stamps), stamps)
    assert len(read_recording(folder)) == 1  # at 100.2, where a pose is
    (folder / "max-gap.txt").write_text("0.31\n")
    np.testing.assert_allclose(read_recording(folder).truth.positions_xyz, PLACES, atol=1e-9)


def test_a_header_without_a_hash_and_a_row_of_nan_cost_nothing_else(tmp_path):
    stamps = 100 + 0.1 * np.arange(N)
    rows = path_at(stamps)
    rows[1] = np.nan
    folder = tum(tmp_path, rows, stamps, header=["timestamp tx ty tz qx qy qz qw"])
    listed = (folder / "rgb.txt").read_text().replace("# color images", "timestamp filename")
    (folder / "rgb.txt").write_text(listed)
    sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.truth.positions_xyz, PLACES[[0, 2, 3, 4]], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: rows * ([1] * 3 + [5] * 4), "pose 0 .* length 5, expected 1"),
        (lambda rows: np.roll(rows, 4, axis=1), "columns 1 to 4 of the pose have unit length: is the order another"),
    ],
)
def test_quaternions_that_are_not_of_unit_length_are_told(tmp_path, change, said):
    stamps = 100 + 0.1 * np.arange(N)
    with pytest.warns(DatasetWarning, match=said):
        read_recording(tum(tmp_path, change(path_at(stamps) + ([0, 3, 0] + [0] * 4)), stamps))


def test_poses_by_another_clock_are_told(tmp_path):
    stamps = 1000 + 0.1 * np.arange(N)
    with pytest.raises(DatasetError, match="from 1970"):
        read_recording(tum(tmp_path, path_at(stamps), stamps + 1.6e9))


@pytest.mark.parametrize("suffix", [".webp", ".pgm"])
def test_folders_of_other_images_are_read(tmp_path, suffix):
    for i in range(N):
        picture(tmp_path / f"{i}.png", i)
        Image.open(tmp_path / f"{i}.png").convert("L").save(tmp_path / f"{i}{suffix}")
        (tmp_path / f"{i}.png").unlink()
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    assert [path.suffix for path in read_recording(tmp_path, require_poses=False).image_paths] == [suffix] * N


def test_stamps_in_scientific_notation_are_exact(tmp_path):
    folder = WRITERS[Layout.EUROC](tmp_path)
    before = read_recording(folder)
    for path in tmp_path.rglob("data.csv"):
        lines = path.read_text().splitlines()
        parts = [line.split(",", 1) for line in lines[1:]]
        path.write_text("\n".join([lines[0], *(f"{s[0]}.{s[1:]}e18,{rest}" for s, rest in parts)]))
    after = read_recording(folder)
    np.testing.assert_array_equal(after.timestamps_s, before.timestamps_s)
    assert len(after) == N


def test_tum_vi_is_read(tmp_path):
    """Poses of ``mocap0``, Kalibr's calibration with a fisheye lens, OpenCV's head of YAML."""
    folder = WRITERS[Layout.EUROC](tmp_path)
    mav = tmp_path / "mav0"
    (mav / "state_groundtruth_estimate0").rename(mav / "mocap0")
    (mav / "cam0" / "sensor.yaml").unlink()
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3], T_body_cam[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.1, 0.02, 0]
    (tmp_path / "dso").mkdir()
    (tmp_path / "dso" / "camchain.yaml").write_text(
        "%YAML:1.0\n---\ncam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n"
        f"  T_cam_imu: {np.linalg.inv(T_body_cam).tolist()}\n  distortion_coeffs: [0.01, 0.002, 0.0, 0.0]\n"
        "  intrinsics: [40, 40, 32, 24]\n  resolution: [64, 48]\n"
    )
    sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-9)
    assert (sequence.camera.fx, sequence.camera.distortion) == (40, ())
    (tmp_path / "dso" / "camchain.yaml").unlink()
    (mav / "cam0" / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    with pytest.warns(DatasetWarning, match="the body's poses are taken as the camera's"):
        body = read_recording(folder)
    np.testing.assert_allclose(body.truth.poses_se3 @ T_body_cam, matrices(), atol=1e-9)


def colmap(root, cameras, of_image):
    """The COLMAP data set with other cameras; `of_image` gives the camera of every image."""
    WRITERS[Layout.COLMAP](root)
    place = root / "sparse" / "0"
    place.joinpath("cameras.txt").write_text("\n".join(cameras) + "\n")
    lines = place.joinpath("images.txt").read_text().splitlines()
    for k, line in enumerate(lines):
        if line.endswith("png"):
            lines[k] = line.replace(" 3 000", f" {of_image[int(line[-5])]} 000")
    place.joinpath("images.txt").write_text("\n".join(lines) + "\n")
    return root


PINHOLE = "PINHOLE 64 48 40 40 32 24"


def test_one_camera_per_image_with_equal_numbers_is_one_camera(tmp_path):
    folder = colmap(tmp_path, [f"{k} {PINHOLE}" for k in range(1, N + 1)], range(1, N + 1))
    sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-9)
    assert all(path.parent.name == "images" for path in sequence.image_paths)


def test_images_of_other_cameras_are_brought_to_that_of_most(tmp_path):
    """A camera of twice the size and focal length, and one with a lens, see what the first sees."""
    cameras = [f"1 {PINHOLE}", "2 PINHOLE 128 96 80 80 64 48", "3 OPENCV 64 48 40 40 32 24 -0.1 0.01 0.001 0.002"]
    folder = colmap(tmp_path, cameras, (1, 2, 3, 1, 1))
    y, x = np.mgrid[:48, :64]
    ramp = np.dstack((4 * x, 5 * y, 0 * x)).astype(np.uint8)
    for name in ("0000", "0002", "0003", "0004"):
        Image.fromarray(ramp).save(folder / "images" / f"{name}.png")
    y, x = np.mgrid[:96, :128] / 2
    Image.fromarray(np.dstack((4 * x, 5 * y, 0 * x)).astype(np.uint8)).save(folder / "images" / "0001.png")
    camera = PinholeCamera(40, 40, 32, 24, 64, 48, (-0.1, 0.01, 0.001, 0.002))
    with pytest.warns(DatasetWarning, match="1 image of fx = 80, 128x96 as of fx = 40, 64x48"):
        sequence = read_recording(folder)
    assert (sequence.camera.fx, sequence.camera.width, sequence.camera.distortion) == (40, 64, ())
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-9)
    np.testing.assert_allclose(sequence.image(1)[2:-2, 2:-2].astype(int), ramp[2:-2, 2:-2].astype(int), atol=3)
    rays = np.array([[0.3, 0.2, 1.0], [-0.5, 0.4, 1.0], [0.1, -0.3, 1.0]])
    at = np.rint(rays[:, :2] * 40 + (32, 24)).astype(int)
    rays[:, :2] = (at - (32, 24)) / 40
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(sequence.image(2)[at[:, 1], at[:, 0], :2], bent[:, 0] * (4, 5), atol=1.5)


def test_a_sequence_is_seen_by_another_camera(tmp_path):
    folder = WRITERS[Layout.IMAGES](tmp_path)
    y, x = np.mgrid[:48, :64]
    for path in folder.glob("*.png"):
        Image.fromarray(np.dstack((4 * x, 5 * y, 0 * x)).astype(np.uint8)).save(path)
    wanted = PinholeCamera(20, 20, 16, 12, 32, 24, (-0.1, 0.01, 0.001, 0.002))
    seen = as_camera(read_recording(folder), wanted)
    assert seen.camera == wanted
    at = np.array([[16, 12], [6, 5], [27, 20]])
    rays = cv2.undistortPoints(at[:, None].astype(float), wanted.matrix, np.array(wanted.distortion))[:, 0]
    np.testing.assert_allclose(seen.image(0)[at[:, 1], at[:, 0], :2], (rays * 40 + (32, 24)) * (4, 5), atol=4)


def test_of_several_models_the_larger_is_read_and_both_are_named(tmp_path):
    folder = colmap(tmp_path, [f"3 {PINHOLE}"], [3] * N)
    first = folder / "sparse" / "0"
    (folder / "sparse" / "1").mkdir()
    for name in ("cameras.txt", "images.txt"):
        (first / name).rename(folder / "sparse" / "1" / name)
    (first / "cameras.txt").write_text(f"3 {PINHOLE}\n")
    (first / "images.txt").write_text("1 1 0 0 0 0 0 0 3 0000.png\n\n")
    with pytest.warns(DatasetWarning, match=r"sparse/1 \(5 images\) is read, not .*sparse/0 \(1 images\)"):
        sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-9)


def test_a_models_own_folder_finds_its_images(tmp_path):
    folder = colmap(tmp_path, [f"3 {PINHOLE}"], [3] * N)
    np.testing.assert_allclose(read_recording(folder / "sparse" / "0").truth.poses_se3, matrices(), atol=1e-9)


def test_a_camera_that_cannot_be_read_and_that_no_image_uses_is_passed_over(tmp_path):
    before = read_recording(as_binary(WRITERS[Layout.COLMAP](tmp_path)))
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    content = path.read_bytes()
    path.write_bytes(struct.pack("<Q", 2) + content[8:] + struct.pack("<iiQQ16d", 9, 11, 64, 48, *[1.0] * 16))
    assert read_recording(tmp_path).camera == before.camera


def reordered(poses, scalar_first):
    """Poses whose quaternions were written with the scalar first, or last, and read the other way."""
    found = poses.copy()
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=scalar_first)
    found[:, :3, :3] = Rotation.from_quat(quats, scalar_first=not scalar_first).as_matrix()
    return found


@pytest.mark.parametrize("data", ["7scenes/redkitchen", "tum/fr1_xyz"])
@pytest.mark.parametrize(
    ("made", "best"),
    [
        (lambda poses: reordered(poses, True), "quaternions wxyz"),
        (lambda poses: reordered(np.linalg.inv(poses), True), "quaternions wxyz, world-to-camera"),
        (
            lambda poses: np.linalg.inv(reordered(np.linalg.inv(poses), False)),
            "quaternions xyzw, as COLMAP's world-to-camera",
        ),
        (lambda poses: poses, "camera-to-world, OpenCV axes"),
        (np.linalg.inv, "world-to-camera, OpenCV axes"),
        (lambda poses: poses @ OPENGL_AXES, "camera-to-world, OpenGL axes"),
        (lambda poses: np.linalg.inv(poses @ OPENGL_AXES), "world-to-camera, OpenGL axes"),
        (lambda poses: MIRRORED @ poses @ MIRRORED, "camera-to-world, left-handed axes with y up (Unity)"),
    ],
)
def test_the_convention_of_given_poses_is_told(real_data, data, made, best):
    sequence = read_recording(real_data(*data.split("/")))
    poses = made(sequence.truth.poses_se3)
    given = replace(sequence, truth=Trajectory.from_poses_se3(sequence.timestamps_s, poses))
    # whatever they were made to be, what undoes it is named
    assert fitting_convention(given)[0] == best
