"""Sound data as different programs write it, and damage to every file of every layout: the right value or a word."""

import json
import os
import re
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.conformal import ConformodalError
from conformodal.geometry import PinholeCamera
from conformodal.geometry.metrics import in_seconds
from conformodal.io import DatasetError, DatasetWarning, Layout, read_image, read_recording
from conformodal.io.convention import FITTED, with_fitted_focal
from conformodal.io.convert import write_layout
from conformodal.io.layouts.images import read_image_folder
from conformodal.io.pose_files import read_tum, tum_table
from conformodal.io.pose_text import fractions_of, lost_faults, matrix_faults
from conformodal.io.reading import by_name
from conformodal.io.streams.stored import RecordingStream

from .test_layouts import PLACES, QUATS, WRITERS, N, as_binary, matrices, picture
from .test_on_disk import PINHOLE, colmap, nerf, path_at

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
STAMPS = 100 + 0.1 * np.arange(N)


def right(sequence):
    """Every frame has its pose."""
    assert len(sequence) == N
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices(), atol=1e-6)


def edit(path, *changes):
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


# ---- times and poses as text


@pytest.mark.parametrize("since", [0.0, 1.6e9, 500.0])
@pytest.mark.parametrize(("factor", "unit"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")])
@pytest.mark.parametrize("where", ["images", "poses", "both"])
def test_times_in_another_unit_are_converted_or_told(tmp_path, since, factor, unit, where):
    folder = WRITERS[Layout.TUM](tmp_path)
    times = dict.fromkeys(("images", "poses"), STAMPS + since)
    scaled = {name: t * factor if where in (name, "both") else t for name, t in times.items()}
    lines = [f"{t:.6f} rgb/{i}.png" for i, t in enumerate(scaled["images"])]
    (folder / "rgb.txt").write_text("\n".join(lines))
    np.savetxt(folder / "groundtruth.txt", np.column_stack((scaled["poses"], path_at(STAMPS))), fmt="%.9f")
    known = since > 1e9 or (unit == "nanoseconds" and since > 0)  # 500 s of nanoseconds are too large for seconds
    try:
        sequence = read_recording(folder)
    except DatasetError as exc:
        assert not known, exc  # noqa: PT017
        assert unit in str(exc)  # noqa: PT017
        return
    right(sequence)
    told = dict(sequence.notes)
    if in_seconds(scaled["images"])[1] or in_seconds(scaled["poses"])[1]:
        np.testing.assert_allclose(sequence.timestamps_s, times["images"], atol=1e-6)
        assert unit in told["times are converted to seconds"]
    else:
        assert "another unit" in told["frame rate is unlikely"]


def test_times_of_a_trajectory_file_are_converted(tmp_path):
    np.savetxt(tmp_path / "t.txt", np.column_stack(((STAMPS + 1.6e9) * 1e9, path_at(STAMPS))), fmt="%.9f")
    with pytest.warns(UserWarning, match="look like nanoseconds"):
        np.testing.assert_allclose(read_tum(tmp_path / "t.txt").timestamps_s, STAMPS + 1.6e9, atol=1e-6)


ORDERED = np.column_stack((STAMPS, PLACES, QUATS))  # w first


@pytest.mark.parametrize(
    ("head", "separator", "rows"),
    [
        ("# timestamp tx ty tz qx qy qz qw", ",", ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]]),
        ("% t,x,y,z", " ; ", ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]]),
        ('"timestamp","tx"', "\t", ORDERED[:, [0, 1, 2, 3, 5, 6, 7, 4]]),
        ("# time x y z qw qx qy qz", " ", ORDERED),
        ("timestamp,p_x,p_y,p_z,q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []", ", ", ORDERED),
    ],
)
def test_poses_in_other_spellings_and_orders(tmp_path, head, separator, rows):
    folder = WRITERS[Layout.TUM](tmp_path)
    lines = [separator.join(f"{v:.9f}" for v in row) for row in rows.tolist()]
    (folder / "groundtruth.txt").write_text("\ufeff" + "\r\n".join([head, *(line + separator for line in lines)]))
    edit(folder / "rgb.txt", ("0 rgb/", "0,rgb\\"))
    (folder / "rgb.txt").write_bytes((folder / "rgb.txt").read_text().encode("utf-16"))
    (folder / "camera-intrinsics.txt").write_text("# mine\n[[40, 0, 32],\n [0, 40, 24], [0, 0, 1]]\n")
    (folder / "camera-distortion.txt").write_text("-0.1, 0.02, 0, 0, 0.001, 0, 0, 0")
    sequence = read_recording(folder)
    right(sequence)
    assert sequence.camera == PinholeCamera(40, 40, 32, 24, 64, 48, (-0.1, 0.02, 0, 0, 0.001))
    assert ("wxyz" in dict(sequence.notes).get("poses are doubtful", "")) == (rows is ORDERED)


SPELT = {
    "nanoseconds without zeros before them": (lambda t: f"{t // 10**9}.{t % 10**9}", True),
    "microseconds without zeros before them": (lambda t: f"{t // 10**9}.{t % 10**9 // 1000}", True),
    "decimals without zeros after them": (lambda t: repr(t / 1e9), False),
    "decimals": (lambda t: f"{t / 1e9:.6f}", False),
}


@pytest.mark.parametrize("spelling", SPELT)
@pytest.mark.parametrize("start", [99_900_005_000, 100_000_005_000])
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.IMAGES])
def test_fractions_of_several_lengths_are_read_as_they_were_written(tmp_path, spelling, start, layout):
    spell, told = SPELT[spelling]
    times = start + 33_000_000 * np.arange(60)
    folder = tmp_path / "fr3"
    named = folder / "rgb" if layout is Layout.TUM else folder
    named.mkdir(parents=True)
    for time in times.tolist():
        Image.new("RGB", (64, 48)).save(named / f"{spell(time)}.png")
    (folder / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    if layout is Layout.TUM:
        (folder / "rgb.txt").write_text("\n".join(f"{spell(time)} rgb/{spell(time)}.png" for time in times.tolist()))
    poses = [f"{spell(time)} {k} 0 0 0 0 0 1" for k, time in enumerate(times.tolist())]
    (folder / "groundtruth.txt").write_text("\n".join(poses))
    sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.timestamps_s, times / 1e9, atol=2e-6)
    np.testing.assert_array_equal(sequence.truth.positions_xyz[:, 0], np.arange(60))
    assert [path.stem for path in sequence.image_paths] == [spell(time) for time in times.tolist()]
    assert ("numbers can be read in two ways" in dict(sequence.notes)) is told


@pytest.mark.parametrize("line", ["bad line", "1 2 3 4 5 6 7"])
def test_a_damaged_line_does_not_change_how_times_are_read(tmp_path, line):
    times = 12_000_005_000 + 33_000_000 * np.arange(60)
    poses = [f"{t // 10**9}.{t % 10**9} 0 0 0 0 0 0 1" for t in times.tolist()]
    (tmp_path / "a.tum").write_text("\n".join([*poses[:7], line, *poses[8:]]))
    damaged, doubts = {}, []
    rows = tum_table(tmp_path / "a.tum", damaged, doubts)
    there = np.delete(np.arange(60), 7)
    np.testing.assert_allclose(rows[there, 0], times[there] / 1e9, atol=1e-9)
    assert any("its number is read as" in doubt for doubt in doubts)


@pytest.mark.parametrize("twice", [[], [9]])
def test_milliseconds_in_order_are_told_from_decimals_by_their_order(twice):
    times = np.cumsum(np.random.default_rng(0).integers(20, 60, 100)) // 10 * 10 + 12_003  # without zeros at ends
    times[50:] += 100_000  # a pause
    times[10 : 10 + len(twice)] = times[twice]
    unpadded = [f"{t // 1000}.{t % 1000}" for t in times.tolist()]
    found, told = fractions_of(unpadded, in_order=True)
    np.testing.assert_allclose(found, times / 1000)
    assert told
    found, told = fractions_of([repr(t / 1000) for t in times.tolist()], in_order=True)
    np.testing.assert_allclose(found, times / 1000)
    assert not told


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["f_0.5.png", "f_0.55.png", "f_0.6.png", "f_1.05.png", "f_1.1.png"], False),
        (["f_0.25.png", "f_0.5.png", "f_0.75.png", "f_1.0.png"], False),
        (["f_1.9.png", "f_1.10.png", "f_1.11.png", "f_2.1.png", "f_10.1.png"], False),
        (["f_2.25.png", "f_2.5.png", "f_10.5.png"], True),
        (["f_1.3.png", "f_1.13.png", "f_1.23.png"], True),
        (["12.5.png", "13.25.png", "14.75.png"], True),
        (["1311868164.3731.png", "1311868164.399557.png"], False),
    ],
)
def test_names_with_fractions_are_in_order(names, told):
    notes = []
    assert by_name(names[::-1], str, notes) == names
    assert bool(notes) is told


@pytest.mark.parametrize("gone", [(), (4,)])
def test_a_header_above_poses_by_line_moves_none(tmp_path, gone):
    folder = WRITERS[Layout.KITTI](tmp_path)
    edit(path := tmp_path / "poses" / "07.txt", (text := path.read_text(), "r11 r12 r13 tx\n" + text))
    for i in gone:
        (folder / "image_0" / f"{i:06d}.png").unlink()
    with pytest.raises(DatasetError, match=r"07\.txt, line 1: begins with a word; .* put # before a header"):
        read_recording(folder)
    edit(path, ("r11", "# r11"))
    np.testing.assert_allclose(read_recording(folder).truth.positions_xyz, np.delete(PLACES, gone, 0), atol=1e-9)


def test_a_quaternion_of_zeros_costs_its_row_and_is_not_normalised(tmp_path):
    folder = WRITERS[Layout.TUM](tmp_path)
    rows = np.column_stack((STAMPS, path_at(STAMPS)))
    rows[2, 4:] = 0
    np.savetxt(folder / "groundtruth.txt", rows)
    sequence = read_recording(folder)
    assert len(sequence) == N - 1
    assert not any("normalised" in where for _, where in sequence.notes)


def lost_as(folder, layout, frames):
    """Write the identity, far from the path, for some frames."""
    if layout is Layout.TUM:
        rows = np.column_stack((STAMPS, path_at(STAMPS) + np.array([70, 0, 0, 0, 0, 0, 0])))
        rows[frames, 1:] = 0, 0, 0, 0, 0, 0, 1
        np.savetxt(folder / "groundtruth.txt", rows)
        return
    for i, path in enumerate(sorted(folder.rglob("*.pose.txt"))):
        pose = np.loadtxt(path)
        pose[0, 3] += 70
        np.savetxt(path, np.eye(4) if i in frames else pose)


@pytest.mark.parametrize("layout", [Layout.TUM, Layout.SEVENSCENES])
@pytest.mark.parametrize("frames", [[0], [2], [2, 3], [N - 1]])
def test_the_identity_far_from_a_path_is_a_lost_camera(tmp_path, layout, frames):
    folder = WRITERS[layout](tmp_path)
    lost_as(folder, layout, frames)
    sequence = read_recording(folder)
    assert len(sequence) == N - len(frames)
    assert (sequence.truth.positions_xyz[:, 0] > 50).all()
    assert any("was the camera lost?" in where for _, where in sequence.notes)


def test_a_path_that_rests_at_the_identity_keeps_it():
    positions = np.zeros((12, 3))
    positions[5:, 0] = 0.01 * np.arange(1, 8)
    assert lost_faults(positions, (positions == 0).all(axis=1)) == {}
    assert lost_faults(np.zeros((4, 3)), np.ones(4, dtype=bool)) == {}


NOISE = 1e-4 * np.random.default_rng(0).normal(size=250)


@pytest.mark.parametrize(
    "x_m",
    [
        np.concatenate((np.zeros(100), 0.02 * np.arange(1, 51), 1 + NOISE)),  # noise makes no jump of a step of 2 cm
        np.append(0, 0.5 + 0.01 * np.arange(99)),  # as SLAM, which needs a baseline first
    ],
)
def test_a_path_that_begins_at_the_identity_keeps_it(x_m):
    positions = np.column_stack((x_m, *np.zeros((2, len(x_m)))))
    assert lost_faults(positions, x_m == 0) == {}
    positions[-9] = 0
    assert list(lost_faults(positions, positions[:, 0] == 0)) == [len(x_m) - 9]


def test_a_matrix_that_is_transposed_says_so():
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    assert matrix_faults(pose.T[None])[0].endswith("; is it transposed?")


# ---- images


def numbered(root, names):
    for i, name in enumerate(names):
        picture(root / name, i)
    (root / "camera-intrinsics.txt").write_text("40 40 32 24")
    return root


def test_a_narrow_part_of_16_bits_is_told(tmp_path):
    """As of thermal cameras."""
    ramp = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    for scale, flat in ((7, False), (1, True)):
        for i in range(3):
            cv2.imwrite(str(tmp_path / f"{i}.png"), (8000 * flat + scale * (ramp // 4)).astype(np.uint16))
        (tmp_path / "camera-intrinsics.txt").write_text("40 40 32 24")
        notes = dict(read_image_folder(tmp_path, require_poses=False).notes)
        assert ("images have little contrast" in notes) is flat
    assert "lie between 8003 and 8764 of 16383" in notes["images have little contrast"]


def test_poses_that_are_not_beside_the_images_say_where_they_go(tmp_path):
    (tmp_path / "images").mkdir()
    numbered(tmp_path / "images", ["1.png", "2.png"])
    (tmp_path / "images" / "camera-intrinsics.txt").rename(tmp_path / "camera-intrinsics.txt")
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match=r"put poses\.tum and camera-intrinsics\.txt into .*images, which holds"):
        read_recording(tmp_path)


def test_of_two_files_of_poses_the_one_that_is_read_is_told(tmp_path):
    folder = without_camera(tmp_path)
    (folder / "camera-intrinsics.txt").write_text("40 40 32 24")
    (folder / "groundtruth.txt").write_text((folder / "poses.tum").read_text())
    notes = dict(read_recording(folder).notes)
    assert notes["other poses are not read"].endswith("poses.tum is read, not groundtruth.txt")


def test_poses_that_are_far_apart_say_what_bridges_them(tmp_path):
    folder = without_camera(tmp_path)
    (folder / "camera-intrinsics.txt").write_text("40 40 32 24")
    (folder / "poses.tum").write_text("".join(f"{t - 0.5} {t} 0 0 0 0 0 1\n" for t in range(4)))
    with pytest.raises(DatasetError, match=r"its poses are 1 s apart: write a longer gap into max-gap\.txt"):
        read_recording(folder)


@pytest.mark.parametrize(
    "names",
    [
        [f"{side}{i:03d}.png" for side in ("left", "right") for i in range(4)],
        [f"{i:03d}{kind}.png" for kind in ("", "_depth") for i in range(4)],
    ],
)
def test_images_of_two_kinds_in_a_folder_are_refused(tmp_path, names):
    with pytest.raises(DatasetError, match=r"images of two kinds, .* which 4 numbers have in common"):
        read_image_folder(numbered(tmp_path, names), require_poses=False)


@pytest.mark.parametrize(
    "names", [["a1.png", "b1.png", "a2.png", "b3.png"], [f"1.{i}.png" for i in range(4)], ["a.png", "b.png", "c.png"]]
)
def test_names_of_other_kinds_are_one_recording(tmp_path, names):
    assert len(read_image_folder(numbered(tmp_path, names), require_poses=False)) == len(names)


@pytest.mark.parametrize(
    ("numbers", "times", "told"),
    [
        ((1, 2, 3, 4), (0, 1, 2, 3), ""),
        (
            (1, 2, 3, 5, 8),
            (0, 1, 2, 4, 7),
            "f005.png is followed by f008.png; times have gaps.*: 1 number is one frame",
        ),
        ((0, 10, 20, 30), (0, 1, 2, 3), "f000.png is followed by f010.png; times are even: 10 numbers are one frame"),
        ((0, 10, 30), (0, 1, 3), "times have gaps"),
        ((0, 10, 20, 30, 31, 40), (0, 1, 2, 3, 3.1, 4), "10 numbers are one frame"),  # one step does not decide
        ((0, 4, 8, 11, 15, 19), (0, 1, 2, 2.75, 3.75, 4.75), "4 numbers are one frame"),  # 8 of 30 per second
    ],
)
def test_names_that_skip_numbers_skip_their_times(tmp_path, numbers, times, told):
    sequence = read_image_folder(numbered(tmp_path, [f"f{k:03d}.png" for k in numbers]), require_poses=False)
    np.testing.assert_allclose(sequence.timestamps_s, np.array(times) / 30, atol=1e-9)
    notes = [where for what, where in sequence.notes if what == "names skip numbers"]
    assert len(notes) == bool(told)
    assert all(re.search(told, where) for where in notes)


@pytest.mark.parametrize("suffix", ["png", "tiff", "ppm"])
@pytest.mark.parametrize("white", [1023, 4095, 65535])
def test_colours_of_16_bits_are_scaled_by_the_bits_in_use(tmp_path, suffix, white):
    rgb = np.empty((6, 8, 3), np.uint16)
    rgb[...] = np.array([1.0, 0.5, 0.25]) * white
    cv2.imwrite(str(tmp_path / f"a.{suffix}"), rgb[..., ::-1])
    np.testing.assert_allclose(read_image(tmp_path / f"a.{suffix}")[0, 0], [255, 127.5, 63.75], atol=0.6)


def test_transparent_and_turned_colours_of_16_bits(tmp_path):
    rgba = np.full((6, 8, 4), 65535, np.uint16)
    rgba[:, :4, 3] = 0
    cv2.imwrite(str(tmp_path / "a.png"), rgba)
    assert read_image(tmp_path / "a.png")[0, [0, 7]].tolist() == [[0] * 3, [255] * 3]
    exif = Image.Exif()
    exif[0x0112] = 6
    content = (tmp_path / "a.png").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        image.load()
    stream = tmp_path / "b.png"
    Image.new("RGB", (8, 6)).save(stream, exif=exif)
    chunk = stream.read_bytes()
    at = chunk.index(b"eXIf") - 4
    size = int.from_bytes(chunk[at : at + 4]) + 12
    stream.write_bytes(content[:33] + chunk[at : at + size] + content[33:])
    assert read_image(stream)[[0, 7], 0].tolist() == [[0] * 3, [255] * 3]


# ---- EuRoC and Kalibr

CHAIN = (
    "cam0:\n{mounting}  camera_model: pinhole\n  distortion_model: {model}\n  distortion_coeffs: [{lens}]\n"
    "  intrinsics: [40, 40, 32, 24]\n  resolution: [64, 48]\n{shift}"
)


@pytest.mark.parametrize(("name", "shift"), [("camchain-imucam.yaml", 0.0), ("rig-camchain.yml", 0.05)])
def test_calibrations_of_kalibr_with_their_clock(tmp_path, name, shift):
    folder = WRITERS[Layout.EUROC](tmp_path)
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").unlink()
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.1, 0.02, 0]
    mounting = f"  T_cam_imu: {np.linalg.inv(back).tolist()}\n"
    text = CHAIN.format(mounting=mounting, model="none", lens="", shift=f"  timeshift_cam_imu: {shift}\n")
    (tmp_path / name).write_text(text)
    sequence = read_recording(folder)
    late = round(shift / 0.05)  # poses are 0.05 s apart
    assert len(sequence) == N - late
    np.testing.assert_allclose(sequence.truth.poses_se3, matrices()[late:], atol=1e-6)
    assert any("timeshift" in where for _, where in sequence.notes) == bool(shift)


def test_a_camera_model_of_other_numbers_is_named(tmp_path):
    folder = WRITERS[Layout.EUROC](tmp_path)
    (tmp_path / "mav0" / "cam0" / "sensor.yaml").unlink()
    text = CHAIN.format(mounting="", model="none", lens="", shift="")
    (tmp_path / "camchain.yaml").write_text(text.replace("pinhole", "ds").replace("[40,", "[-0.2, 0.6, 40,"))
    with pytest.raises(DatasetError, match="has camera model ds, expected pinhole: undistort"):
        read_recording(folder)


@pytest.mark.parametrize("where", ["sensor.yaml", "camchain.yaml"])
def test_a_calibration_without_a_mounting_says_so(tmp_path, where):
    folder = WRITERS[Layout.EUROC](tmp_path)
    path = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    path.unlink()
    text = "intrinsics: [40, 40, 32, 24]\ndistortion_coefficients: [0, 0, 0, 0]\n"
    lens = "0, 0, 0, 0"
    text = text if where == "sensor.yaml" else CHAIN.format(mounting="", model="radtan", lens=lens, shift="")
    path.with_name(where).write_text(text)
    with pytest.warns(DatasetWarning, match="no mounting"):
        read_recording(folder)


# ---- NeRF

OWN = dict.fromkeys(("camera_angle_x", "cx", "cy"))
WIDE = 2 * np.arctan(32 / 40)


@pytest.mark.parametrize(
    ("top", "frame", "focal"),
    [
        ({"camera_angle_x": float(np.degrees(WIDE))}, {}, (40, 40)),
        ({"camera_angle_x": None, "camera_angle_y": 2 * np.arctan(24 / 44)}, {}, (44, 44)),
        ({"camera_angle_x": None, "fl_y": 44}, {}, (44, 44)),
        ({"camera_angle_x": None, "fl_x": "40.0", "w": "64", "h": 48.0}, {}, (40, 40)),
        (OWN, {"fl_x": 40, "fl_y": 41}, (40, 41)),
        ({"fl_x": 80, "fl_y": 80}, {"camera_angle_x": WIDE}, (40, 40)),
        ({"fl_x": 80, "fl_y": 80}, {"fl_x": 40}, (40, 40)),
        ({"fl_x": 40, "fl_y": 41}, {"camera_angle_x": None}, (40, 41)),
    ],
)
def test_cameras_of_nerf_in_other_spellings(tmp_path, top, frame, focal):
    sequence = read_recording(nerf(tmp_path, top=top, frames=[frame] * N))
    assert (sequence.camera.fx, sequence.camera.fy) == pytest.approx(focal)
    right(sequence)


@pytest.mark.parametrize(
    ("top", "match"),
    [
        ({"camera_angle_x": 0}, "radians between"),
        ({"distortion_params": [0.1, 0, 0, 0]}, "distortion_params"),
        ({"applied_scale": 0}, "applied_scale is 0"),
        ({"camera_angle_x": None}, "says no camera"),
    ],
)
def test_what_nerf_cannot_mean_is_refused(tmp_path, top, match):
    with pytest.raises(DatasetError, match=match):
        read_recording(nerf(tmp_path, top=top))


@pytest.mark.parametrize("how", ["suffix left out", "backslashes", "three rows"])
def test_frames_of_nerf_in_other_spellings(tmp_path, how):
    frames = [{}] * N
    opengl = (matrices() * [1, -1, -1, 1])[:, :3]
    if how == "three rows":
        frames = [{"transform_matrix": pose.tolist()} for pose in opengl]
    nerf(
        tmp_path, frames=frames if how != "backslashes" else [{"file_path": f".\\images\\000{i}.png"} for i in range(N)]
    )
    if how == "suffix left out":
        for path in (tmp_path / "images").glob("*.png"):
            Image.open(path).save(path.with_suffix(".WEBP"), "WEBP")
            path.unlink()
    right(read_recording(tmp_path))


def test_one_image_by_a_hard_link_is_refused(tmp_path):
    nerf(tmp_path)
    (tmp_path / "images" / "0001.png").unlink()
    os.link(tmp_path / "images" / "0000.png", tmp_path / "images" / "0001.png")
    with pytest.raises(DatasetError, match="twice"):
        read_recording(tmp_path)


# ---- COLMAP


@pytest.mark.parametrize("how", ["prefix", "backslash"])
def test_images_of_colmap_are_found_where_they_are(tmp_path, how):
    folder = colmap(tmp_path, [f"3 {PINHOLE}"], [3] * N)
    images, model = folder / "images", folder / "sparse" / "0"
    if how == "prefix":
        edit(model / "images.txt", (" 3 0", " 3 images/0"))
    else:
        images.rename(folder / "left")
        images.mkdir()
        (folder / "left").rename(images / "left")
        edit(model / "images.txt", (" 3 0", " 3 left\\0"))
    right(read_recording(folder))


def test_folders_of_images_are_recordings(tmp_path):
    folder = colmap(tmp_path, [f"3 {PINHOLE}"], [3] * N)
    names = [f"{'left' if i < 3 else 'right'}/000{i}.png" for i in range(N)]
    for i, name in enumerate(names):
        (folder / "images" / name).parent.mkdir(exist_ok=True)
        (folder / "images" / f"000{i}.png").rename(folder / "images" / name)
    edit(folder / "sparse" / "0" / "images.txt", *((f" 3 000{i}.png", f" 3 {name}") for i, name in enumerate(names)))
    sequence = read_recording(folder)
    right(sequence)
    picture(folder / "images" / "left" / "0001b.png", 7)  # which COLMAP found no pose for
    whole = read_recording(folder, require_poses=False)
    assert [path.name for path in whole.image_paths][:3] == ["0000.png", "0001.png", "0001b.png"]
    assert whole.recording.tolist() == [0, 0, 0, 0, 1, 1]
    assert whole.posed.tolist() == [0, 1, 3, 4, 5]
    assert sequence.recording.tolist() == [0, 0, 0, 1, 1]
    assert sequence.timestamps_s[3] - sequence.timestamps_s[2] > 5


def test_of_a_model_in_both_formats_the_binary_is_read_as_by_colmap(tmp_path):
    folder = colmap(tmp_path, [f"3 {PINHOLE}"], [3] * N)
    place = folder / "sparse" / "0"
    texts = {path: path.read_text() for path in place.glob("*.txt")}
    as_binary(folder)
    for path, text in texts.items():
        path.write_text(text.replace("40 40", "55 55"))
    sequence = read_recording(folder)
    right(sequence)
    assert sequence.camera.fx == 40


TURNED = {"w": 48, "h": 64, "fl_x": 40, "cx": 24, "cy": 32}


@pytest.mark.parametrize(
    ("turn", "camera"),
    [(turn, camera) for turn in (3, 6) for camera in (PINHOLE, {}, {"w": 64, "h": 48})]
    + [(6, "PINHOLE 48 64 40 40 24 32"), (6, TURNED)],
)
def test_images_are_those_of_their_cameras_whatever_exif_says(tmp_path, turn, camera):
    """Programs read images as they are stored; whoever turned them first has a camera of the other shape."""
    folder = nerf(tmp_path, top=camera) if isinstance(camera, dict) else colmap(tmp_path, [f"3 {camera}"], [3] * N)
    exif = Image.Exif()
    exif[0x0112] = turn
    corner = np.zeros((48, 64, 3), np.uint8)
    corner[:8, :8] = 200
    for path in (folder / "images").glob("*.png"):
        Image.fromarray(corner).save(path, exif=exif)
    sequence = read_recording(folder)
    right(sequence)
    stored = sequence.camera.width == 64
    assert sequence.image(1)[0, 0 if stored else -1].tolist() == [200] * 3
    assert ("images are read as they are stored" in dict(sequence.notes)) == stored
    assert sequence.recording.tolist() == [0] * N


@pytest.mark.parametrize("camera", [1, 3])
def test_the_other_cameras_of_kitti_and_whole_matrices(tmp_path, camera):
    folder = WRITERS[Layout.KITTI](tmp_path)
    (folder / "image_0").rename(folder / f"image_{camera}")
    edit(folder / "calib.txt", ("P2", f"P{camera}"))
    np.savetxt(tmp_path / "poses" / "07.txt", matrices().reshape(N, 16))
    poses = matrices()
    poses[:, :3, 3] -= poses[:, :3, 0] * 0.2  # 8 / 40 m to the left of its own axes
    np.testing.assert_allclose(read_recording(folder).truth.poses_se3, poses, atol=1e-6)


@pytest.mark.parametrize("text", ["40 41 32 24", "40 0 32 0\n0 41 24 0\n0 0 1 0\n0 0 0 1"])
def test_intrinsics_as_four_numbers_and_as_a_whole_matrix(tmp_path, text):
    folder = WRITERS[Layout.IMAGES](tmp_path)
    (folder / "camera-intrinsics.txt").write_text(text)
    assert read_recording(folder).camera == PinholeCamera(40, 41, 32, 24, 64, 48)


@pytest.mark.parametrize("line", ["{t} rgb/{i}.png {t} depth/{i}.png", "{t} depth/{i}.png {t} rgb/{i}.png"])
def test_lists_of_associated_images_and_depths(tmp_path, line):
    folder = WRITERS[Layout.TUM](tmp_path)
    for form in ("{}", "{:.6e}"):
        lines = [line.format(t=form.format(t), i=i) for i, t in enumerate(STAMPS)]
        (folder / "rgb.txt").write_text("\n".join(lines))
        right(read_recording(folder))


@pytest.mark.parametrize(("name", "focal"), [("fr1_desk", 517.3), ("my-fr3", 535.4), ("fr10_desk", 0), ("frafr2", 0)])
def test_the_camera_by_a_folder_s_name_is_that_of_the_whole_name(tmp_path, name, focal):
    folder = WRITERS[Layout.TUM](tmp_path).rename(tmp_path / name)
    (folder / "camera-intrinsics.txt").unlink()
    for path in (folder / "rgb").iterdir():
        Image.new("RGB", (640, 480)).save(path)
    if focal:
        assert read_recording(folder).camera.fx == focal
    else:
        with pytest.raises(DatasetError, match="no camera is known"):
            read_recording(folder)


def test_a_mounting_as_four_rows_quoted_names_and_lenses_that_are_null(tmp_path):
    folder = WRITERS[Layout.EUROC](tmp_path / "euroc")
    sensor = tmp_path / "euroc" / "mav0" / "cam0" / "sensor.yaml"
    numbers = re.search(r"data: \[(.*)\]", sensor.read_text())[1].split(", ")
    rows = ", ".join(f"[{', '.join(numbers[k : k + 4])}]" for k in (0, 4, 8, 12))
    edit(sensor, (", ".join(numbers), rows), ("0.00002]", "2e-05]"))
    path = sensor.with_name("data.csv")
    path.write_text("\n".join(f'"{line}"'.replace(",", '","') for line in path.read_text().splitlines()))
    right(sequence := read_recording(folder))
    assert sequence.camera.distortion[3] == 2e-5
    right(read_recording(nerf(tmp_path / "nerf", top={"camera_model": "OPENCV"}, frames=[{"k1": None}] * N)))


def test_positions_in_millimetres_are_told(tmp_path):
    folder = WRITERS[Layout.TUM](tmp_path)
    rows = np.column_stack((STAMPS, path_at(STAMPS)))
    rows[:, 1:4] *= 1000
    np.savetxt(folder / "groundtruth.txt", rows)
    assert "moves at 5e+03 m/s" in dict(read_recording(folder).notes)["speed is unlikely"]


@pytest.mark.parametrize("turn", [3, 6])
def test_images_that_exif_turns_are_written_as_they_are_shown(tmp_path, turn):
    """A COLMAP model would have them as they are stored."""
    folder = WRITERS[Layout.IMAGES](tmp_path / "a")
    exif = Image.Exif()
    exif[0x0112] = turn
    for path in folder.glob("*.png"):
        pixels = np.zeros((48, 64, 3) if turn == 3 else (64, 48, 3), np.uint8)
        pixels[:8, :8] = 200
        Image.fromarray(pixels).save(path, exif=exif)
    given = read_recording(folder)
    write_layout(tmp_path / "b", Layout.COLMAP, RecordingStream(given), given.camera, given.truth)
    right(sequence := read_recording(tmp_path / "b"))
    np.testing.assert_array_equal(sequence.image(0), given.image(0))


def test_files_that_are_not_read_are_named(tmp_path):
    for name in ("a.heic", "b.heic", "camera-intrinsics.txt"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"2 \.heic files; .* images as \.png"):
        read_recording(tmp_path)


def test_a_camera_that_is_given_twice_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="line 2: gives camera 3"):
        read_recording(colmap(tmp_path, [f"3 {PINHOLE}", "3 PINHOLE 64 48 50 50 32 24"], [3] * N))


# ---- focal length


def without_camera(root, exif=None):
    for i in range(N):
        picture(root / f"{i}.jpg", i)
        Image.new("RGB", (64, 48)).save(root / f"{i}.jpg", exif=Image.Exif() if exif is None else exif)
    np.savetxt(root / "poses.tum", np.column_stack((np.arange(N) / 30, path_at(STAMPS))))
    return root


@pytest.mark.parametrize(
    ("tags", "focal"),
    [
        ({0xA405: 26}, 26 / np.hypot(36, 24) * 80),
        ({0x920A: 4.0, 0xA20E: 10.0, 0xA210: 4, 0xA002: 128}, 20.0),
        ({0x920A: 4.0, 0xA20E: 10.0, 0xA210: 4, 0xA002: 96, 0xA003: 128}, 20.0),
    ],
)
def test_without_intrinsics_the_focal_length_is_that_of_exif(tmp_path, tags, focal):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    sequence = read_recording(without_camera(tmp_path, exif))
    assert sequence.camera.fx == pytest.approx(focal, rel=1e-6)
    assert (sequence.camera.cx, sequence.camera.cy) == (32, 24)
    assert "give or take" in dict(sequence.notes)["the camera is not calibrated"]


def test_a_focal_length_is_taken_from_the_user_or_refused(tmp_path):
    folder = without_camera(tmp_path)
    with pytest.raises(DatasetError, match="--focal auto"):
        read_recording(folder)
    assert read_recording(folder, focal="50").camera.fx == 50
    for focal, match in (("-1", "positive"), ("x", "positive"), ("auto", "tell no focal length")):
        with pytest.raises(DatasetError, match=match):
            read_recording(folder, focal=focal)
    (folder / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    with pytest.raises(DatasetError, match="is given too"):
        read_image_folder(folder, focal_px=50.0)
    with pytest.raises(DatasetError, match="nerf has a camera"):
        read_recording(nerf(tmp_path / "nerf"), focal=50)


@pytest.mark.parametrize(
    ("folder", "focal"), [("7scenes/redkitchen", 525.5), ("tum/fr1_desk", 516.9), ("tum/fr1_xyz", 516.9)]
)
def test_a_fitted_focal_length_lies_in_its_range(real_data, folder, focal):
    """Of redkitchen, the published truth by COLMAP; of TUM's first camera, whose lens is not modelled, its makers'."""
    sequence = without_lens(read_recording(real_data(*folder.split("/"))))
    fitted = with_fitted_focal(sequence)
    low, high = map(int, re.search(r"between (\d+) and (\d+)", dict(fitted.notes)[FITTED]).groups())
    assert low < focal < high < 1.25 * low
    assert fitted.camera.fx == pytest.approx(focal, rel=0.06)


def test_a_camera_that_hardly_turns_does_not_show_its_focal_length(real_data):
    sequence = without_lens(read_recording(real_data("kitti", "sequences", "06")))
    with pytest.raises(DatasetError, match=r"turns by 0\.1\d degrees"):
        with_fitted_focal(sequence)


def without_lens(sequence):
    camera = sequence.camera
    middle = {"cx": camera.width / 2, "cy": camera.height / 2}
    return replace(sequence, camera=replace(camera, fx=100.0, fy=100.0, distortion=(), **middle))


# ---- damage

KEEPS = {
    "mark": lambda text: "\ufeff" + text,
    "line ends": lambda text: text.replace("\n", "\r\n"),
    "blank lines at the end": lambda text: text.rstrip("\n") + "\n\n\n",
    "spaces at line ends": lambda text: text.replace("\n", "  \n"),
}


def on_lines(change):
    def changed(text):
        lines = text.splitlines()
        return "\n".join(change(lines, max(0, len(lines) // 2))) + "\n"

    return changed


HURTS = {
    "empty": lambda text: "",
    "cut": lambda text: text[: len(text) // 2],
    "no number": on_lines(lambda lines, k: [*lines[:k], lines[k].replace("0", "nan", 1), *lines[k + 1 :]]),
    "a word": on_lines(lambda lines, k: [*lines[:k], "oops", *lines[k + 1 :]]),
    "short line": on_lines(lambda lines, k: [*lines[:k], lines[k][: len(lines[k]) // 2], *lines[k + 1 :]]),
    "huge": on_lines(lambda lines, k: [*lines[:k], lines[k].replace("0", "9e99", 1), *lines[k + 1 :]]),
}
STAMPED = {  # of files whose lines do not stand for frames by their number
    "line gone": on_lines(lambda lines, k: [*lines[:k], *lines[k + 1 :]]),
    "line twice": on_lines(lambda lines, k: [*lines[:k], lines[k], *lines[k:]]),
    "backwards": on_lines(lambda lines, k: lines[::-1]),
}
FILES = {
    Layout.SEVENSCENES: ("frame-000002.pose.txt", "camera-intrinsics.txt"),
    Layout.RGBD_SCENES: ("02.pose",),
    Layout.KITTI: ("calib.txt", "times.txt", "07.txt"),
    Layout.TUM: ("rgb.txt", "groundtruth.txt"),
    Layout.EUROC: ("sensor.yaml", "cam0/data.csv", "estimate0/data.csv"),
    Layout.COLMAP: ("cameras.txt", "images.txt"),
    Layout.NERF: ("transforms.json",),
    Layout.IMAGES: ("poses.tum",),
}
BY_TIME = ("rgb.txt", "groundtruth.txt", "data.csv", "poses.tum")


@pytest.mark.parametrize("layout", FILES)
def test_damage_to_any_file_is_told_and_no_frame_gets_another_pose(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    whole = read_recording(folder, layout)
    poses = dict(zip((path.name for path in whole.image_paths), whole.truth.poses_se3, strict=True))
    seen = Counter()
    for name in FILES[layout]:
        path = max(p for p in tmp_path.rglob("*") if str(p).endswith(name))
        text = path.read_text()
        for what, damage in {**KEEPS, **HURTS, **(STAMPED if name.endswith(BY_TIME) else {})}.items():
            path.write_bytes(damage(text).encode())
            try:
                sequence = read_recording(folder, layout, require_poses=True)
            except ConformodalError as exc:
                assert what not in KEEPS, (name, what, exc)  # noqa: PT017
                assert "\n" not in str(exc)  # noqa: PT017
                seen["refused"] += 1
                continue
            finally:
                path.write_text(text)
            assert sequence.notes or sequence.camera == whole.camera, (name, what)
            assert sequence.notes or len(sequence) == N or what in STAMPED, (name, what)
            for image, pose in zip(sequence.image_paths, sequence.truth.poses_se3, strict=True):
                # the neighbours of a row without a time are interpolated between, which is told
                atol = 1e-3 if "poses are interpolated" in dict(sequence.notes) else 1e-6
                np.testing.assert_allclose(pose, poses[image.name], atol=atol, err_msg=f"{name}, {what}")
            seen["read"] += 1
    assert min(seen["refused"], seen["read"]) > 0, json.dumps(seen)
