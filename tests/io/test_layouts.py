"""Every layout is written as published, with a scene whose answer is known: the camera walks along x and turns left."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.geometry import PoseError
from conformodal.io import DatasetError, DatasetWarning, Layout, read_recording, recognise

N, SIZE = 5, (64, 48)
# seen from above, with z up: looks along x first, then turns to the left by 10 degrees a frame
LEVEL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TURNS = Rotation.from_euler("z", 10.0 * np.arange(N)[:, None], degrees=True) * LEVEL
PLACES = np.column_stack((0.5 * np.arange(N), np.zeros(N), np.full(N, 1.5)))
QUATS = TURNS.as_quat(scalar_first=True)
K = "40 0 32\n0 40 24\n0 0 1\n"


def picture(path, i):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", SIZE, (10 * i, 0, 0)).save(path)


def matrices():
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = TURNS.as_matrix(), PLACES
    return poses


def write_sevenscenes(root):
    for i, pose in enumerate(matrices()):
        picture(root / "seq-01" / f"frame-{i:06d}.color.png", i)
        np.savetxt(root / "seq-01" / f"frame-{i:06d}.pose.txt", pose)
    (root / "camera-intrinsics.txt").write_text(K)
    (root / "frame-rate.txt").write_text("10\n")
    return root


def write_rgbd_scenes(root):
    for scene in ("01", "02"):
        for i in range(N):
            picture(root / "imgs" / f"scene_{scene}" / f"{i:05d}-color.png", i)
            picture(root / "imgs" / f"scene_{scene}" / f"{i:05d}-depth.png", i)
        (root / "pc").mkdir(exist_ok=True)
        np.savetxt(root / "pc" / f"{scene}.pose", np.column_stack((QUATS, PLACES)))
        (root / "imgs" / f"scene_{scene}" / "camera-intrinsics.txt").write_text(K)
    return root / "imgs" / "scene_02"


def write_kitti(root):
    sequence = root / "sequences" / "07"
    for i in range(N):
        picture(sequence / "image_0" / f"{i:06d}.png", i)
    (sequence / "calib.txt").write_text("P0: 40 0 32 0 0 40 24 0 0 0 1 0\nP2: 40 0 32 8 0 40 24 0 0 0 1 0\n")
    (sequence / "times.txt").write_text("\n".join(f"{0.1 * i:.6e}" for i in range(N)))
    (root / "poses").mkdir()
    np.savetxt(root / "poses" / "07.txt", matrices()[:, :3].reshape(N, 12))
    return sequence


def write_tum(root):
    folder = root / "rgbd_dataset_freiburg3_walk"
    lines = ["# color images"]
    for i in range(N):
        picture(folder / "rgb" / f"{i}.png", i)
        lines.append(f"{100 + 0.1 * i:.4f} rgb/{i}.png")
    (folder / "rgb.txt").write_text("\n".join(lines))
    stamps = 100 + 0.1 * np.arange(N)
    rows = np.column_stack((stamps, PLACES, QUATS[:, 1:], QUATS[:, :1]))
    np.savetxt(folder / "groundtruth.txt", rows, header="timestamp tx ty tz qx qy qz qw")
    (folder / "camera-intrinsics.txt").write_text(K)
    return folder


def write_euroc(root):
    cam = root / "mav0" / "cam0"
    lines = ["#timestamp [ns],filename"]
    for i in range(N):
        stamp = 1403636579763555584 + 50_000_000 * i
        picture(cam / "data" / f"{stamp}.png", i)
        lines.append(f"{stamp},{stamp}.png")
    (cam / "data.csv").write_text("\n".join(lines))
    # the camera sits 0.1 m to the side of the body and is turned by a quarter about its axis
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3], T_body_cam[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.1, 0.02, 0]
    body = matrices() @ np.linalg.inv(T_body_cam)
    quats = Rotation.from_matrix(body[:, :3, :3]).as_quat(scalar_first=True)
    truth = root / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    rows = ["#timestamp, p_RS_R_x [m], ..."]
    for i in range(N):
        numbers = ",".join(f"{v:.12f}" for v in (*body[i, :3, 3], *quats[i], 0.0, 0.0, 0.0))
        rows.append(f"{1403636579763555584 + 50_000_000 * i},{numbers}")
    truth.write_text("\n".join(rows))
    (cam / "sensor.yaml").write_text(
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: "
        f"{T_body_cam.ravel().tolist()}\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [40, 40, 32, 24]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]\n"
    )
    return root


def write_colmap(root):
    """World to camera, as COLMAP stores it, with a line of points after every image."""
    lines = ["# Image list", "# with two lines an image"]
    backward = np.linalg.inv(matrices())
    quats = Rotation.from_matrix(backward[:, :3, :3]).as_quat(scalar_first=True)
    for i in reversed(range(N)):  # COLMAP keeps no order
        picture(root / "images" / f"{i:04d}.png", i)
        numbers = " ".join(f"{v:.12f}" for v in (*quats[i], *backward[i, :3, 3]))
        lines += [f"{i + 7} {numbers} 3 {i:04d}.png", "10.5 11.5 -1 12.0 13.0 44"]
    (root / "sparse" / "0").mkdir(parents=True)
    (root / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    (root / "sparse" / "0" / "cameras.txt").write_text(
        "# cameras\n3 OPENCV 64 48 40 40 32.5 24.5 -0.1 0.02 0.001 0.002\n"
    )
    (root / "metres-per-unit.txt").write_text("1\n")
    (root / "frame-rate.txt").write_text("10\n")
    return root


def write_nerf(root):
    """Cameras that look along -z with y up."""
    frames = []
    for i, pose in enumerate(matrices()):
        picture(root / "images" / f"{i:04d}.png", i)
        opengl = np.column_stack((pose[:, 0], -pose[:, 1], -pose[:, 2], pose[:, 3]))
        frames.append({"file_path": f"./images/{i:04d}", "transform_matrix": opengl.tolist()})
    content = {"camera_angle_x": 2 * np.arctan(32 / 40), "cx": 32.5, "cy": 24.5, "frames": frames[::-1]}
    (root / "transforms.json").write_text(json.dumps(content))
    (root / "metres-per-unit.txt").write_text("1\n")
    (root / "frame-rate.txt").write_text("10\n")
    return root


def write_images(root):
    for i in range(N):
        picture(root / f"{100 + 0.1 * i:.6f}.png", i)
    rows = np.column_stack((100 + 0.1 * np.arange(N), PLACES, QUATS[:, 1:], QUATS[:, :1]))
    np.savetxt(root / "poses.tum", rows)
    (root / "camera-intrinsics.txt").write_text(K)
    return root


WRITERS = {
    Layout.SEVENSCENES: write_sevenscenes,
    Layout.RGBD_SCENES: write_rgbd_scenes,
    Layout.KITTI: write_kitti,
    Layout.TUM: write_tum,
    Layout.EUROC: write_euroc,
    Layout.COLMAP: write_colmap,
    Layout.NERF: write_nerf,
    Layout.IMAGES: write_images,
}


@pytest.mark.parametrize("layout", WRITERS)
def test_the_known_scene_is_read_from_every_layout(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    assert recognise(folder) == layout
    sequence = read_recording(folder)
    assert len(sequence) == N
    assert (sequence.recording == 0).all()
    np.testing.assert_allclose(sequence.require_truth().poses_se3, matrices(), atol=1e-9)
    step = {Layout.RGBD_SCENES: 1 / 30, Layout.EUROC: 0.05}.get(layout, 0.1)
    np.testing.assert_allclose(np.diff(sequence.timestamps_s), step, atol=1e-6)
    camera = sequence.camera
    assert (camera.fx, camera.cx, camera.width, camera.height) == pytest.approx((40, 32, *SIZE), rel=1e-12)
    assert len(sequence.camera.distortion) == (4 if layout in (Layout.EUROC, Layout.COLMAP) else 0)
    for i in range(N):
        assert sequence.image(i)[0, 0].tolist() == [10 * i, 0, 0]
    # what the camera looks at: along x at first, to the left after nine frames
    forward = sequence.require_truth().poses_se3[:, :3, 2]
    np.testing.assert_allclose(forward[0], [1, 0, 0], atol=1e-9)
    assert (np.diff(forward[:, 1]) > 0).all()


@pytest.mark.parametrize("layout", [Layout.KITTI, Layout.TUM, Layout.EUROC, Layout.RGBD_SCENES])
def test_sequences_without_poses_are_read_if_asked(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    for path in [*tmp_path.rglob("poses/*.txt"), *tmp_path.rglob("groundtruth.txt"), *tmp_path.rglob("*.pose")]:
        path.unlink()
    for path in tmp_path.rglob("state_groundtruth_estimate0/data.csv"):
        path.unlink()
    with pytest.raises(DatasetError, match=r"07\.txt|groundtruth|data\.csv|\.pose"):
        read_recording(folder)
    sequence = read_recording(folder, require_poses=False)
    assert len(sequence) == N
    assert sequence.truth is None
    with pytest.raises(PoseError, match="no poses"):
        sequence.require_truth()


def test_images_without_pose_are_left_out_of_training(tmp_path):
    folder = write_tum(tmp_path)
    path = folder / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-2]))  # the last two poses are gone
    assert len(read_recording(folder)) == N - 2
    whole = read_recording(folder, require_poses=False)
    assert len(whole) == N
    assert whole.truth is None
    path.write_text("900.0 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"groundtruth\.txt: no image has a pose"):
        read_recording(folder)


def test_real_data_are_recognised_and_read(real_data):
    kitti = read_recording(real_data("kitti", "sequences", "06"))
    assert len(kitti) == 51
    # the car drives along the camera's axis
    step = np.diff(kitti.require_truth().positions_xyz, axis=0)
    forward = kitti.require_truth().poses_se3[:-1, :3, 2]
    assert (np.sum(step * forward, axis=1) > 0.9 * np.linalg.norm(step, axis=1)).all()
    tum = read_recording(real_data("tum", "fr3_cabinet"))
    assert tum.camera.fx == 535.4
    assert len(tum) == len(tum.require_truth()) > 50
    assert recognise(real_data("7scenes", "redkitchen", "seq-01")) == Layout.SEVENSCENES


def test_folders_in_no_layout_or_in_two_are_named(tmp_path):
    with pytest.raises(DatasetError, match=r"7scenes: frame-NNNNNN.*kitti: image_0"):
        recognise(tmp_path)
    with pytest.raises(DatasetError, match="no such file or folder"):
        recognise(tmp_path / "nowhere")
    (tmp_path / "rgb.txt").write_text("")
    (tmp_path / "frame-000000.color.png").write_text("")
    with pytest.raises(DatasetError, match="could be 7scenes or tum"):
        recognise(tmp_path)


def test_a_scene_without_a_pose_file_has_frames_without_poses(tmp_path):
    write_rgbd_scenes(tmp_path)
    for scene in (tmp_path / "imgs").iterdir():
        (scene / "camera-intrinsics.txt").unlink()
    (tmp_path / "camera-intrinsics.txt").write_text(K)
    (tmp_path / "pc" / "01.pose").unlink()
    with pytest.warns(DatasetWarning, match=r"5 x no pose: 00000-color\.png: .*01\.pose: poses are missing"):
        whole = read_recording(tmp_path, require_poses=False)
    assert len(whole) == 2 * N
    np.testing.assert_array_equal(whole.poses.timestamps_s, whole.timestamps_s[N:])
    with pytest.warns(DatasetWarning, match="5 x left out, no pose"):
        posed = read_recording(tmp_path)
    np.testing.assert_array_equal(posed.timestamps_s, whole.timestamps_s[N:])
    assert (posed.recording == 1).all()
    (tmp_path / "pc" / "02.pose").unlink()
    with pytest.raises(DatasetError, match=r"01\.pose: poses are missing"):
        read_recording(tmp_path)
