"""Sound data as their formats' own documentation has them, and doubts about what may be read wrongly."""

import json
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.geometry import PinholeCamera
from conformodal.io import DatasetError, FrameTable, Layout, Reader, read_recording, readers, registry
from conformodal.io.pose_files import read_tum
from tests.helpers import invoke

from .test_layouts import PLACES, QUATS, WRITERS, N, matrices, picture

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
STAMPS = 100 + 0.1 * np.arange(N)


def right(recording):
    """Every frame has its pose."""
    assert len(recording) == N
    np.testing.assert_allclose(recording.require_truth().poses_se3, matrices(), atol=1e-6)


def path_at(times):
    """Rows of TUM: the path of the known scene, 5 m/s along x and 100 degrees per second to the left."""
    turned = Rotation.from_euler("z", (100 * (times - 100))[:, None], degrees=True)
    quats = (turned * Rotation.from_quat(QUATS[0], scalar_first=True)).as_quat()
    return np.column_stack((times, 5 * (times - 100), np.zeros(len(times)), np.full(len(times), 1.5), quats))


def tum(root, rows, head=""):
    folder = WRITERS[Layout.TUM](root)
    np.savetxt(folder / "groundtruth.txt", rows, header=head, fmt="%.9f", comments="")
    return folder


# ---- a layout of one's own


def test_a_package_adds_a_layout_by_an_entry_point(tmp_path, monkeypatch):
    def read(folder):
        return FrameTable("mine", [folder / "a.png"], np.zeros(1), PinholeCamera(40, 40, 32, 24, 64, 48))

    module = type(sys)("their_package")
    module.READER = Reader(read, lambda folder: (folder / "mine").is_file(), "a file 'mine'")
    monkeypatch.setitem(sys.modules, "their_package", module)
    point = EntryPoint("mine", "their_package:READER", registry.ENTRY_POINTS)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == registry.ENTRY_POINTS else [])
    readers.cache_clear()
    try:
        picture(tmp_path / "a.png", 1)
        (tmp_path / "mine").touch()
        assert read_recording(tmp_path, require_poses=False).name == "mine"
        with pytest.raises(DatasetError, match="poses are missing"):
            read_recording(tmp_path, "mine")
        module.READER = "no reader"
        readers.cache_clear()
        with pytest.raises(DatasetError, match="mine is not a Reader"):
            read_recording(tmp_path)
    finally:
        readers.cache_clear()


# ---- times


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")])
def test_epoch_time_units_are_converted_and_reported(tmp_path, factor, unit):
    times = STAMPS + 1.6e9
    folder = tum(tmp_path, np.column_stack((times * factor, path_at(STAMPS)[:, 1:])))
    lines = [f"{t * factor:.6f} rgb/{i}.png" for i, t in enumerate(times)]
    (folder / "rgb.txt").write_text("\n".join(lines))
    right(recording := read_recording(folder))
    np.testing.assert_allclose(recording.timestamps_s, times, atol=1e-6)
    assert unit in dict(recording.notes)["times are converted to seconds"]
    with pytest.warns(UserWarning, match=unit):
        np.testing.assert_allclose(read_tum(folder / "groundtruth.txt").timestamps_s, times, atol=1e-6)


@pytest.mark.parametrize(("rate", "shift"), [(10, 0.004), (10, 0.05), (100, 0.003), (15, 0.0)])
def test_poses_at_another_rate_are_interpolated(tmp_path, rate, shift):
    recording = read_recording(tum(tmp_path, path_at(99.9 + shift + np.arange(8 * rate // 10) / rate)))
    right(recording)
    assert shift == 0.0 or any(f"gap bridged is {1 / rate:.3g} s" in where for _, where in recording.notes)


def test_a_gap_that_is_too_long_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"within 0\.15 s .*give poses at the images' times"):
        read_recording(tum(tmp_path, path_at(99.95 + 0.3 * np.arange(4))))


@pytest.mark.parametrize(
    ("names", "even"),
    [
        (["f001", "f002", "f003", "f005", "f006"], None),  # with a file of times
        ([f"{100 + 0.1 * i:.6f}" for i in range(N)], True),
        ([f"{1_403_636_579_000_000_000 + 100_000_000 * i}" for i in range(N)], True),
        ([f"shot_{i + 8}" for i in range(N)], True),
        (["20240131125958", "20240131125959", "20240131130000", "20240131130001", "20240131130002"], True),
        (["f001", "f002", "f003", "f005", "f006"], False),
    ],
)
def test_image_times_come_from_names_or_the_frame_rate(tmp_path, names, even):
    """Gaps in the numbers are reported."""
    for i, name in enumerate(names):
        picture(tmp_path / f"{name}.png", i)
    (tmp_path / "camera-intrinsics.txt").write_text("40 40 32 24")
    (tmp_path / "frame-rate.txt").write_text("10")
    if even is None:
        (tmp_path / "times.txt").write_text("1 1.1 1.2 1.4 1.5")
    recording = read_recording(tmp_path, require_poses=False)
    steps = [0.1, 0.1, 0.2, 0.1] if even is None else 0.1
    np.testing.assert_allclose(np.diff(recording.timestamps_s), steps, atol=1e-6)
    assert [int(recording.image(i)[0, 0, 0]) for i in range(N)] == [10 * i for i in range(N)]
    assert ("names skip numbers" in dict(recording.notes)) == (even is False)


# ---- poses

ORDERED = np.column_stack((STAMPS, PLACES, QUATS))  # w first


@pytest.mark.parametrize(
    ("head", "separator", "rows"),
    [
        ("# timestamp tx ty tz qx qy qz qw", ",", ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]]),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", "\t", ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]]),
        ("# time x y z qw qx qy qz", " ", ORDERED),
        ("timestamp,p_x,p_y,p_z,q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []", ", ", ORDERED),
    ],
)
def test_pose_header_gives_order_with_any_separator(tmp_path, head, separator, rows):
    folder = WRITERS[Layout.TUM](tmp_path)
    lines = [separator.join(f"{v:.9f}" for v in row) for row in rows.tolist()]
    (folder / "groundtruth.txt").write_text("\ufeff" + "\r\n".join([head, *lines]))
    right(recording := read_recording(folder))
    assert ("wxyz" in dict(recording.notes).get("poses are doubtful", "")) == (rows is ORDERED)


# head, separator, and what stands in each column: of a row, w first, or another number
NAMED = {
    "a number of frames": ("timestamp, frame, x, y, z, qx, qy, qz, qw", ", ", [0, 7, 1, 2, 3, 5, 6, 7, 4]),
    "an id behind": ("#timestamp x y z qx qy qz qw id", " ", [0, 1, 2, 3, 5, 6, 7, 4, "12"]),
    "an index before": ("index,timestamp,tx,ty,tz,qw,qx,qy,qz", ",", ["12", 0, 1, 2, 3, 4, 5, 6, 7]),
    "topics of ROS": (
        "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.pose.position.x,"
        "field.pose.pose.position.y,field.pose.pose.position.z,field.pose.pose.orientation.x,"
        "field.pose.pose.orientation.y,field.pose.pose.orientation.z,field.pose.pose.orientation.w,"
        "field.twist.twist.linear.x,field.twist.twist.linear.y,field.twist.twist.linear.z",
        ",",
        ["7", "1", 0, "odom", 1, 2, 3, 5, 6, 7, 4, "0.5", "0.5", "0.5"],
    ),
    "seconds and nanoseconds": ("sec;nanosec;x;y;z;qx;qy;qz;qw", ";", ["100", "ns", 1, 2, 3, 5, 6, 7, 4]),
    "velocities before": ("time vx vy vz px py pz qw qx qy qz", "\t", [0, "1", "1", "1", 1, 2, 3, 4, 5, 6, 7]),
    "names of images first": ("image,timestamp,x,y,z,qx,qy,qz,qw", ",", ["a.png", 0, 1, 2, 3, 5, 6, 7, 4]),
    "quotes and units in names": ('"time_sec","x_m","y_m","z_m","qw","qx","qy","qz","rms"', ",", [*range(8), "1"]),
    "rotation and translation": (
        "time translation.x translation.y translation.z rotation.x rotation.y rotation.z rotation.w euler.x",
        " ",
        [0, 1, 2, 3, 5, 6, 7, 4, "3"],
    ),
    "units": ("# time [s], pos_x [m], pos_y [m], pos_z [m], q_w, q_x, q_y, q_z, std_x", ", ", [*range(8), "0.1"]),
}


@pytest.mark.parametrize("what", NAMED)
def test_columns_are_found_by_their_names(tmp_path, what):
    head, separator, columns = NAMED[what]
    folder = WRITERS[Layout.TUM](tmp_path)
    lines = []
    for row in ORDERED.tolist():
        nanoseconds = f"{round((row[0] - 100) * 1e9):09d}"
        texts = [nanoseconds if c == "ns" else c if isinstance(c, str) else f"{row[c]:.9f}" for c in columns]
        lines.append(separator.join(texts))
    (folder / "groundtruth.txt").write_text("\n".join(["# exported", head, *lines]))
    right(read_recording(folder))


@pytest.mark.parametrize(
    ("head", "match"),
    [
        ("# timestamp x y z qx qy qz qw x", "names x twice, as x and x"),
        ("# poses", "names its 9 columns; name all columns in the line before"),
        ("# timestamp x y z roll pitch yaw a b", "9 columns, where it has '# timestamp x y z roll pitch yaw a b'"),
    ],
)
def test_extra_column_error_names_the_remedy(tmp_path, head, match):
    rows = np.column_stack((ORDERED, np.ones(N)))
    with pytest.raises(DatasetError, match=match):
        read_recording(tum(tmp_path, rows, head))


@pytest.mark.parametrize("separator", [" ", ";", "; ", "\t"])
def test_decimal_commas_are_read_and_reported(tmp_path, separator):
    folder = WRITERS[Layout.TUM](tmp_path)
    rows = ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]].tolist()
    lines = [separator.join(f"{v:.9f}" for v in row).replace(".", ",") for row in rows]
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    right(recording := read_recording(folder))
    assert "commas are read as decimal marks" in dict(recording.notes)["poses are doubtful"]


@pytest.mark.parametrize("n_further", [6, 9, 12, 21, 36])
def test_covariances_behind_poses_are_passed_over(tmp_path, n_further):
    rows = np.column_stack((ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]], np.full((N, n_further), 0.25)))
    right(recording := read_recording(tum(tmp_path, rows)))
    assert "poses are doubtful" not in dict(recording.notes)
    with pytest.raises(DatasetError, match="expected 8 numbers"):  # 12 are KITTI's
        read_recording(tum(tmp_path / "other", rows[:, :12]))


@pytest.mark.parametrize("head", ["", "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x []\n"])
def test_euroc_ground_truth_warns_of_body_poses(tmp_path, head):
    stamps = 1403636579763555584 + 50_000_000 * np.arange(N)
    lines = [f"{t},{','.join(map(str, row[1:]))}{',0.0' * 9}" for t, row in zip(stamps, ORDERED, strict=True)]
    (tmp_path / "data.csv").write_text(head + "\n".join(lines))
    with pytest.warns(UserWarning, match="EuRoC's body, not of its camera"):
        truth = read_tum(tmp_path / "data.csv")
    np.testing.assert_allclose(truth.poses_se3, matrices(), atol=1e-9)
    np.testing.assert_allclose(truth.timestamps_s, stamps / 1e9, rtol=0, atol=1e-6)


def test_positions_in_millimetres_are_reported(tmp_path):
    rows = path_at(STAMPS) * np.repeat([1, 1000, 1], [1, 3, 4])
    assert "moves at 5e+03 m/s" in dict(read_recording(tum(tmp_path, rows)).notes)["speed is unlikely"]


@pytest.mark.parametrize("camera", [1, 3])
def test_the_other_cameras_of_kitti_and_images_that_are_missing(tmp_path, camera):
    folder = WRITERS[Layout.KITTI](tmp_path)
    (folder / "image_0").rename(folder / f"image_{camera}")
    (folder / "calib.txt").write_text((folder / "calib.txt").read_text().replace("P2", f"P{camera}"))
    (folder / f"image_{camera}" / "000002.png").unlink()
    (folder / "times.txt").unlink()
    poses = matrices()[[0, 1, 3, 4]]
    poses[:, :3, 3] -= poses[:, :3, 0] * 0.2  # 8 / 40 m to the left of its own axes
    recording = read_recording(folder)
    np.testing.assert_allclose(recording.require_truth().poses_se3, poses, atol=1e-6)
    np.testing.assert_allclose(recording.timestamps_s, [0, 0.1, 0.3, 0.4])


@pytest.mark.parametrize(("name", "focal"), [("fr1_desk", 517.3), ("my-fr3", 535.4), ("fr10_desk", 0)])
def test_the_camera_by_a_folder_s_name_is_that_of_the_whole_name(tmp_path, name, focal):
    folder = WRITERS[Layout.TUM](tmp_path).rename(tmp_path / name)
    (folder / "camera-intrinsics.txt").unlink()
    for path in (folder / "rgb").iterdir():
        Image.new("RGB", (640, 480)).save(path)
    if focal:
        assert read_recording(folder).camera.fx == focal
        return
    with pytest.raises(DatasetError, match="no camera is known"):
        read_recording(folder)
    assert read_recording(folder, focal=50).camera.fx == 50
    with pytest.raises(DatasetError, match="positive"):
        read_recording(folder, focal=-1)


# ---- NeRF


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


@pytest.mark.parametrize(
    ("top", "frame", "focal"),
    [
        (dict.fromkeys(("camera_angle_x", "cx", "cy")), {"fl_x": 40, "fl_y": 41, "w": 64, "h": 48}, (40, 41)),
        ({"fl_x": 40, "fl_y": 41, "k1": -0.1, "p2": 0.002}, {"camera_angle_x": None}, (40, 41)),
        ({"camera_angle_x": None, "fl_x": 80, "fl_y": 82, "cx": 65, "cy": 49, "w": 128, "h": 96}, {}, (40, 41)),
    ],
)
def test_cameras_of_nerf_are_those_of_the_frame_or_the_file(tmp_path, top, frame, focal):
    right(recording := read_recording(nerf(tmp_path, top=top, frames=[frame] * N)))
    assert (recording.camera.fx, recording.camera.fy) == pytest.approx(focal)
    assert (recording.camera.cx, recording.camera.cy) == (
        (31.5, 23.5) if "cx" in top and top["cx"] is None else (32, 24)
    )
    assert recording.camera.distortion == ((-0.1, 0, 0, 0.002) if "k1" in top else ())


@pytest.mark.parametrize("how", ["another suffix", "three rows", "backslashes", "training frames"])
def test_frames_of_nerf_as_its_programs_write_them(tmp_path, how):
    opengl = (matrices() * [1, -1, -1, 1])[:, :3]
    changes = {
        "three rows": [{"transform_matrix": pose.tolist()} for pose in opengl],
        "backslashes": [{"file_path": f".\\images\\000{i}.png"} for i in range(N)],
    }
    name = "transforms_train.json" if how == "training frames" else "transforms.json"
    nerf(tmp_path, name=name, frames=changes.get(how))
    if how == "another suffix":
        for path in (tmp_path / "images").glob("*.png"):
            Image.open(path).save(path.with_suffix(".WEBP"), "WEBP")
            path.unlink()
    if how == "training frames":
        (tmp_path / "transforms_test.json").write_text("{}")
    right(read_recording(tmp_path))


@pytest.mark.parametrize("layout", [Layout.COLMAP, Layout.NERF])
def test_model_units_are_arbitrary_without_a_scale(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    path = folder / "metres-per-unit.txt"
    path.write_text("2.5\n")
    scaled = read_recording(folder)
    np.testing.assert_allclose(scaled.truth.positions_xyz, 2.5 * PLACES, atol=1e-9)
    assert (scaled.unit, scaled.notes) == ("m", ())
    path.unlink()
    own = read_recording(folder)
    assert (own.unit, [note.what for note in own.notes]) == ("units", ["the scale is its own"])
    output = invoke("data", "check", folder).output
    assert "units, path" in output
    assert " m, path" not in output
    path.write_text("-1\n")
    with pytest.raises(DatasetError, match=r"metres-per-unit\.txt: holds \[-1\.0\]"):
        read_recording(folder)


# ---- images


@pytest.mark.parametrize(
    ("names", "alike"),
    [
        ([f"{side}{i:03d}.png" for side in ("left", "right") for i in range(4)], False),
        ([f"{i:03d}{kind}.png" for kind in ("", "_depth") for i in range(4)], False),
        (["a1.png", "b1.png", "a2.png", "b3.png"], True),
        (["a.png", "b.png", "c.png"], True),
    ],
)
def test_images_of_two_kinds_in_a_folder_are_refused(tmp_path, names, alike):
    for i, name in enumerate(names):
        picture(tmp_path / name, i)
    (tmp_path / "camera-intrinsics.txt").write_text("40 40 32 24")
    if alike:
        assert len(read_recording(tmp_path, require_poses=False)) == len(names)
        return
    with pytest.raises(DatasetError, match=r"images of two kinds, .* which 4 numbers have in common"):
        read_recording(tmp_path, require_poses=False)


@pytest.mark.parametrize("layout", [Layout.COLMAP, Layout.NERF])
def test_images_that_exif_turns_do_not_fit_poses_of_stored_ones(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGB", (64, 48)).save(folder / "images" / "0002.png", exif=exif)
    with pytest.raises(DatasetError, match=r"0002\.png: EXIF turns it"):
        read_recording(folder)
