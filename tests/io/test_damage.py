"""Damage of every kind to data sets of every layout: it costs a frame, which is named, or the file is refused by name.

Nothing shifts, and nothing outside the folder is read.
"""

import json
import os
import re
import shutil
import unicodedata
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from conformodal.conformal import ConformodalError
from conformodal.io import DatasetError, DatasetWarning, ImageError, Layout, read_recording
from conformodal.io.cameras import camera_of
from conformodal.io.pose_files import matrix_faults, pose_faults
from tests.helpers import LFS_POINTER
from tests.io.test_layouts import SIZE, WRITERS, N, matrices, picture

# what a test does not match is not its point
pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
SEVEN, RGBD, KITTI, TUM = Layout.SEVENSCENES, Layout.RGBD_SCENES, Layout.KITTI, Layout.TUM
EUROC, COLMAP, NERF, IMAGES = Layout.EUROC, Layout.COLMAP, Layout.NERF, Layout.IMAGES
NAN, INF = float("nan"), float("inf")


def file_of(root, name):
    return max(p for p in root.rglob("*") if str(p).endswith("/" + name))


# ---- damage that costs a frame


def expect(folder, layout, before, lost, match, *, always=False):
    """One frame is lost to training and named; the others are as before. `always`: to every reading."""
    kept = [i for i in range(N) if i != lost]
    with pytest.warns(DatasetWarning, match=match):
        recording = read_recording(folder, layout)
    assert recording.image_paths == tuple(before.image_paths[i] for i in kept)
    np.testing.assert_allclose(recording.timestamps_s, before.timestamps_s[kept])
    np.testing.assert_allclose(recording.require_truth().poses_se3, before.truth.poses_se3[kept], atol=1e-9)
    assert recording.camera == before.camera
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        everything = read_recording(folder, layout, require_poses=False)
    assert everything.image_paths == (recording.image_paths if always else before.image_paths)


def replaced(make):
    def change(path):
        path.unlink()
        make(path)

    return change


UNREADABLE = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:60]),
    "a folder": replaced(Path.mkdir),
    "a pipe": replaced(os.mkfifo),
    "a broken link": replaced(lambda path: path.symlink_to("nowhere.png")),
    "a device": replaced(lambda path: path.symlink_to("/dev/zero")),
    "another size": lambda path: Image.new("RGB", (128, 96)).save(path),
}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("damage", UNREADABLE)
def test_a_bad_image_costs_its_frame(tmp_path, layout, damage):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    place = (list(WRITERS).index(layout) + list(UNREADABLE).index(damage)) % 2 * 3  # the first, or one in the middle
    UNREADABLE[damage](before.image_paths[place])
    expect(folder, layout, before, place, before.image_paths[place].name)
    with pytest.raises(ImageError, match=before.image_paths[place].name):
        read_recording(folder, require_poses=False).image(place)


# where the pose of frame 2 is: its file, the first word of the pose, the first number of the position
PLACES = {TUM: ("groundtruth.txt", 1, 0), KITTI: ("07.txt", 0, 3), SEVEN: ("frame-000002.pose.txt", 0, 3)}


def change_pose(layout, root, change):
    """Change the words of frame 2's pose, as they are in its file."""
    name, start, _ = PLACES[layout]
    path = file_of(root, name)
    if layout is SEVEN:
        path.write_text(" ".join(change(path.read_text().split())))
        return
    lines = path.read_text().splitlines()
    at = [k for k, line in enumerate(lines) if not line.startswith("#")][2]
    words = lines[at].split()
    lines[at] = " ".join([*words[:start], *change(words[start:])])
    path.write_text("\n".join(lines) + "\n")


def position(value):
    return lambda layout: lambda words: [value if k == PLACES[layout][2] else word for k, word in enumerate(words)]


@pytest.mark.parametrize("value", ["nan", "1e400", "1e200"])
@pytest.mark.parametrize("layout", PLACES)
def test_a_bad_pose_costs_its_frame(tmp_path, value, layout):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    change_pose(layout, tmp_path, position(value)(layout))
    expect(folder, layout, before, 2, before.image_paths[2].name)


def test_invalid_poses_are_reported_by_row():
    poses = matrices()
    poses[0, :3, :3] *= 1.1
    poses[1, :3, 0] *= -1
    poses[2, 3] = poses[2, :, 3]
    assert {i: why[:13] for i, why in matrix_faults(poses).items()} == {
        0: "is not a rota", 1: "is not a rota", 2: "its last row "
    }  # fmt: skip
    assert list(pose_faults(np.zeros((2, 3)), np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]))) == [1]


@pytest.mark.parametrize("layout", PLACES)
@pytest.mark.parametrize("damage", ["1_0", "lost", "cut"])
def test_a_pose_that_is_not_numbers_is_refused_by_its_line(tmp_path, layout, damage):
    folder = WRITERS[layout](tmp_path)
    change = position(damage)(layout)
    change_pose(layout, tmp_path, (lambda words: words[: len(words) // 3]) if damage == "cut" else change)
    with pytest.raises(DatasetError, match=PLACES[layout][0]):
        read_recording(folder)


def test_two_poses_for_one_time_are_refused(tmp_path):
    folder = WRITERS[TUM](tmp_path)
    path = folder / "groundtruth.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, " ".join([lines[3].split()[0], "7", *lines[3].split()[2:]])]) + "\n")
    with pytest.raises(DatasetError, match="two poses for time"):
        read_recording(folder)


# ---- files that are refused


def put(name, content):
    return lambda root: file_of(root, name).write_text(content)


def sub(name, old, new, count=-1):
    return lambda root: put(name, file_of(root, name).read_text().replace(old, new, count))(root)


def add(name, content):
    return lambda root: (root / name).write_text(content)


def drop(name):
    return lambda root: file_of(root, name).unlink()


def nerf(changes, frame=None):
    def change(root):
        content = json.loads((root / "transforms.json").read_text())
        (content if frame is None else content["frames"][frame]).update(changes)
        (root / "transforms.json").write_text(json.dumps(content))

    return change


def blank_line(name):
    def change(root):
        lines = file_of(root, name).read_text().splitlines()
        put(name, "\n".join([*lines[:3], "", *lines[3:]]) + "\n")(root)

    return change


POINTS = "10.5 11.5 -1 12.0 13.0 44\n"
ONE_POSE = "1 0 0 0 0 1 0 0 0 0 1 0\n"
# layout, change of a file, the file that is named
REFUSED = [
    (SEVEN, lambda r: picture(r / "seq-1" / "frame-000000.color.png", 25), "seq-0?1"),
    (SEVEN, lambda r: [p.unlink() for p in r.rglob("*.pose.txt")], r"000000\.pose\.txt"),
    (SEVEN, drop("camera-intrinsics.txt"), "camera-intrinsics"),
    (SEVEN, lambda r: [p.unlink() for p in r.rglob("frame-0*")], "frame-NNNNNN"),
    (SEVEN, add("camera-distortion.txt", "-0.28 0.07\n"), r"camera-distortion\.txt"),
    *[(x, put("camera-intrinsics.txt", "-40 40 32 24"), r"camera-intrinsics\.txt") for x in (SEVEN, RGBD, TUM)],
    (EUROC, sub("sensor.yaml", "[40, 40", "[-40, 40"), r"sensor\.yaml: intrinsics"),
    (NERF, nerf({"camera_angle_x": None, "fl_x": 0.5}), r"transforms\.json"),
    *[(SEVEN, add("frame-rate.txt", x), r"frame-rate\.txt") for x in ("nan", "0", "30 30")],
    (RGBD, put("02.pose", "1 0 0 0 0 0 0\n"), r"02\.pose"),
    (RGBD, blank_line("02.pose"), r"02\.pose, line 4"),
    *[
        (KITTI, put("calib.txt", text), r"calib\.txt.*P0")
        for text in (
            "P1: 1\n", "P0: 40 0 0 0 0 40 0 0 32 24 1 0", "P0: 1 0 0 0 0 1 0 0 0 0 1 0",
            "P0: 40 0 32 0 0 40 24 0 0 0 0 0", "P0: 40 0 32 0 0 40 24 0 0 0 1 nan",
        )
    ],
    (KITTI, put("times.txt", "0 1\n"), r"times\.txt"),
    (KITTI, put("times.txt", "5 4 3 2 1\n"), r"00000\d\.png"),
    (KITTI, put("07.txt", ONE_POSE), r"07\.txt"),
    (KITTI, put("07.txt", "r11 r12 r13 tx\n" + ONE_POSE * N), r"07\.txt, line 1"),
    (KITTI, blank_line("07.txt"), r"07\.txt, line 4"),
    (TUM, put("rgb.txt", "# nothing\n"), r"rgb\.txt"),
    (TUM, drop("camera-intrinsics.txt"), "camera-intrinsics"),
    (EUROC, drop("sensor.yaml"), r"sensor\.yaml"),
    (EUROC, sub("sensor.yaml", "T_BS", "T_SB"), r"sensor\.yaml"),
    (EUROC, sub("sensor.yaml", "radial-tangential", "equidistant"), r"sensor\.yaml: .*undistort"),
    (EUROC, sub("sensor.yaml", "-1.0", "-1.1", 1), r"sensor\.yaml"),  # not a rotation
    *[
        (COLMAP, sub("images.txt", *change), r"images\.txt")
        for change in (
            (" 3 0002", " 4 0002"), (POINTS, "", 1), (" 0003.png", ""), ("0003.png", "0002.png"),
            ("0003.png", "0002.PNG"), (" 3 0003", " 3_0 0003"), ("44\n", "44\n1 2 3 4 5 6 7 8 9 10 11 12\n", 1),
        )
    ],
    (COLMAP, add("times.txt", "1 2 4\n"), r"times\.txt"),
    *[
        (COLMAP, put("cameras.txt", f"3 {camera}\n"), r"cameras\.txt, camera 3")
        for camera in (
            "OPENCV_FISHEYE 64 48 40 40 32 24 0.1 0.1 0.1 0.1", "FULL_OPENCV 64 48 40 40 32 24 0.1 0 0 0 0 0.1 0 0",
            "PINHOLE 64 48 40 40 32 24 1", "PINHOLE 64 48 nan 40 32 24", "OPENCV 64 48 40 40 32 24", "RADIAL 64 48 40",
        )
    ],
    (NERF, lambda r: put("transforms.json", (r / "transforms.json").read_text()[:-20])(r), r"transforms\.json"),
    (NERF, sub("transforms.json", "/00", "/01"), r"transforms\.json"),
    *[
        (NERF, nerf(changes), r"transforms\.json: ")
        for changes in (
            {"camera_angle_x": 0}, {"camera_angle_x": 90.0}, {"distortion_params": [0.1]},
            {"camera_model": "OPENCV_FISHEYE"}, {"camera_model": ["OPENCV"]}, {"is_fisheye": True},
            {"camera_model": "OPENCV", "is_fisheye": True}, {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1},
        )
    ],
    *[
        (NERF, nerf(changes, frame=2), r"transforms\.json: ")
        for changes in (
            {"w": 128}, {"fl_x": 41}, {"camera_model": "FISHEYE"}, {"file_path": "images/0000.png"},
            {"file_path": "images/../images/0000"},
        )
    ],
    (IMAGES, drop("poses.tum"), r"poses\.tum"),
    (IMAGES, add("groundtruth.txt", "1 0 0 0 0 0 0 1"), r"poses\.tum and in groundtruth\.txt"),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "change", "match"), REFUSED)
def test_a_damaged_data_set_is_refused_by_its_file(tmp_path, layout, change, match):
    folder = WRITERS[layout](tmp_path)
    change(tmp_path)
    with pytest.raises(DatasetError, match=match) as caught:
        read_recording(folder, layout)
    assert "\n" not in str(caught.value)


def test_images_without_camera_error_names_what_is_missing(tmp_path):
    picture(tmp_path / "photos" / "a.png", 1)
    for folder in (tmp_path / "photos", tmp_path):
        with pytest.raises(DatasetError, match=r"images: images and camera-intrinsics\.txt or poses"):
            read_recording(folder)


# ---- cameras


# what: (fx, fy, cx, cy, lens), in images of 64x48
NOT_CAMERAS = {
    "fx is NaN": ((NAN, 40, 32, 24, ()), "fx = nan, expected positive and finite"),
    "fx is negative": ((-40, 40, 32, 24, ()), "fx = -40.0, expected positive and finite"),
    "cy is infinite": ((40, 40, 32, INF, ()), "cy = inf, expected finite pixels"),
    "fx sees 179 degrees": ((0.5, 40, 32, 24, ()), "field of view of 178 degrees"),
    "k1 is 1e9": ((40, 40, 32, 24, (1e9, 0, 0, 0)), "moves the image's corner by 1e.09"),
    "k2 is NaN": ((40, 40, 32, 24, (0, NAN, 0, 0)), "all finite; got .0, nan, 0, 0"),
}
UNLIKELY = {
    "principal point right of the image": ((40, 40, 640, 24, ()), "principal point .* far from"),
    "intrinsics of ten times the size": ((400, 400, 320, 240, ()), "about 640x480"),
    "fx twice fy": ((80, 40, 32, 24, ()), "fx = 80 and fy = 40"),
    "a view of 145 degrees": ((10, 10, 32, 24, ()), "field of view of 145"),
    "a lens that folds the image": ((40, 40, 32, 24, (-2.0, 0, 0, 0)), "folds"),
    "intrinsics of half the size": ((20, 20, 15.75, 11.75, ()), "about 32x24"),
    "intrinsics of two thirds of the size": ((27, 27, 21, 16, ()), "about 42x32"),
    "intrinsics of turned images": ((40, 40, 24, 32, ()), "turned by 90 degrees .48x64."),
}
# the same, where view or lens alone would be refused for another reason
OF_OTHER_IMAGES = {
    "half the size, with its lens": ((20, 20, 15.75, 11.75, (0.26, -0.95, -0.005, 0.003, 1.16)), "about 32x24"),
    "an eightieth of the size": ((0.5, 0.5, 0.4, 0.3, ()), "shares of the image's sides"),
    "a twentieth of the size": ((2.5, 2.5, 3.2, 2.4, ()), "about 6x5"),
    "shares of the sides": ((0.6, 0.8, 0.5, 0.5, ()), "shares of the image's sides"),
}


@pytest.mark.parametrize("what", NOT_CAMERAS)
def test_what_is_not_a_camera_is_refused_by_its_file(what):
    (*pixels, lens), match = NOT_CAMERAS[what]
    with pytest.raises(DatasetError, match=f"^a file: .*{match}"):
        camera_of("a file", pixels, SIZE, lens, notes=[])


@pytest.mark.parametrize("what", UNLIKELY)
def test_unlikely_camera_is_read_and_reported(what):
    """A usual camera gives no note."""
    (*pixels, lens), match = UNLIKELY[what]
    notes = []
    camera = camera_of("a file", pixels, SIZE, lens, notes=notes)
    assert (camera.fx, camera.cy) == (pixels[0], pixels[3])
    assert any(re.search(f"a file: .*{match}", where) for _, where in notes)
    camera_of("a file", (41.0, 40.0, 33.0, 23.0), SIZE, (-0.1, 0.02, 0.001, 0.002), notes=(usual := []))
    assert usual == []


@pytest.mark.parametrize("what", OF_OTHER_IMAGES)
def test_camera_of_other_images_is_refused_as_such(what):
    """Not for its field of view or its lens, which would be refused as well."""
    (*pixels, lens), match = OF_OTHER_IMAGES[what]
    with pytest.raises(DatasetError, match=match) as caught:
        camera_of("a file", pixels, SIZE, lens, notes=[])
    assert not re.search("field of view|fisheye", str(caught.value))


# ---- what stands in the place of a data set or of its files


@pytest.mark.parametrize("layout", WRITERS)
def test_pointers_of_git_lfs_are_named(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    read_recording(folder, layout).image_paths[0].write_bytes(LFS_POINTER)
    with pytest.warns(DatasetWarning, match="is a pointer of Git LFS, not the file; fetch it by 'git lfs pull'"):
        recording = read_recording(folder, layout)
    for path in recording.image_paths:
        path.write_bytes(LFS_POINTER)
    with pytest.raises(DatasetError, match="is a pointer of Git LFS"):
        read_recording(folder, layout)


def test_archives_that_were_not_unpacked_are_named(tmp_path):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path / "scene")
    for kind, found in (("zip", "zip"), ("gztar", "gzip")):
        archive = shutil.make_archive(str(tmp_path / "scene"), kind, folder)
        with pytest.raises(DatasetError, match=rf"scene\.\S+: is an archive \({found}\); unpack it, and"):
            read_recording(archive)
    shutil.rmtree(folder / "seq-01")
    shutil.make_archive(str(folder / "seq-01"), "zip", tmp_path)
    with pytest.raises(DatasetError, match=r"scene: holds 1 archive, such as seq-01\.zip; unpack them there"):
        read_recording(folder)


def test_the_folder_in_a_folder_is_named(tmp_path):
    WRITERS[Layout.SEVENSCENES](tmp_path / "outer" / "scene")
    with pytest.raises(DatasetError, match="outer: is not in a layout that is read, and its folder scene is; name"):
        read_recording(tmp_path / "outer")


# ---- what does no harm


def expect_the_same(folder, before):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        after = read_recording(folder)
    assert (after.image_paths, after.camera, after.notes) == (before.image_paths, before.camera, ())
    np.testing.assert_array_equal(after.timestamps_s, before.timestamps_s)
    np.testing.assert_array_equal(after.truth.positions_xyz, before.truth.positions_xyz)


@pytest.mark.parametrize("layout", WRITERS)
def test_what_systems_leave_behind_is_no_frame(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    for path in {p.parent for p in tmp_path.rglob("*") if p.is_file()}:
        for junk in ("._{name}", ".DS_Store", "Thumbs.db", ".{name}.swp", "{name}.part", ".hidden.png"):
            (path / junk.format(name=before.image_paths[0].name)).write_bytes(b"\0\5\x16\7")
    expect_the_same(folder, before)


@pytest.mark.parametrize("layout", [TUM, EUROC, COLMAP, NERF])
@pytest.mark.parametrize("change", [str.upper, lambda name: unicodedata.normalize("NFD", f"ü{name}")])
def test_names_in_another_case_or_unicode_form_are_found(tmp_path, layout, change):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    list_of_names = next(tmp_path.rglob(NAMED[layout][0]))
    for path in before.image_paths:
        path.rename(path.with_name(change(path.name)))
        if change is not str.upper:
            before_name = {TUM: "rgb/", EUROC: ",", COLMAP: " 3 ", NERF: "images/"}[layout]
            text = list_of_names.read_text().replace(before_name + path.stem, f"{before_name}ü{path.stem}")
            list_of_names.write_text(text)
    read = read_recording(folder)
    assert [path.name for path in read.image_paths] == [change(path.name) for path in before.image_paths]
    np.testing.assert_array_equal(read.truth.positions_xyz, before.truth.positions_xyz)


CHANGES = {
    "BOM and CRLF": lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"),
    "CR": lambda content: content.replace(b"\n", b"\r"),
    "blank lines at the end": lambda content: content.rstrip(b"\n") + b"\n\n\n",
}


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("change", CHANGES)
def test_texts_of_other_systems_are_read_the_same(tmp_path, layout, change):
    folder = WRITERS[layout](tmp_path)
    before = read_recording(folder)
    for path in [p for p in tmp_path.rglob("*") if p.suffix in (".txt", ".csv", ".yaml", ".json", ".pose", ".tum")]:
        path.write_bytes(CHANGES[change](path.read_bytes()))
    expect_the_same(folder, before)


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
    SEVEN: ("frame-000002.pose.txt", "camera-intrinsics.txt"),
    RGBD: ("02.pose",),
    KITTI: ("calib.txt", "times.txt", "07.txt"),
    TUM: ("rgb.txt", "groundtruth.txt"),
    EUROC: ("sensor.yaml", "cam0/data.csv", "estimate0/data.csv"),
    COLMAP: ("cameras.txt", "images.txt"),
    NERF: ("transforms.json",),
    IMAGES: ("poses.tum",),
}
BY_TIME = ("rgb.txt", "groundtruth.txt", "data.csv", "poses.tum")


@pytest.mark.parametrize("layout", FILES)
def test_damaged_files_are_reported_and_shift_no_pose(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    whole = read_recording(folder, layout)
    poses = dict(zip((path.name for path in whole.image_paths), whole.truth.poses_se3, strict=True))
    outcomes = Counter()
    for name in FILES[layout]:
        path = max(p for p in tmp_path.rglob("*") if str(p).endswith(name))
        text = path.read_text()
        for what, damage in (HURTS | (STAMPED if name.endswith(BY_TIME) else {})).items():
            path.write_bytes(damage(text).encode())
            try:
                recording = read_recording(folder, layout, require_poses=True)
            except ConformodalError as exc:
                assert "\n" not in str(exc)  # noqa: PT017
                outcomes["refused"] += 1
                continue
            finally:
                path.write_text(text)
            assert recording.notes or recording.camera == whole.camera, (name, what)
            assert recording.notes or len(recording) == N or what in STAMPED, (name, what)
            for image, pose in zip(recording.image_paths, recording.truth.poses_se3, strict=True):
                # the neighbours of a row without a time are interpolated between, which is told
                atol = 1e-3 if "poses are interpolated" in dict(recording.notes) else 1e-6
                np.testing.assert_allclose(pose, poses[image.name], atol=atol, err_msg=f"{name}, {what}")
            outcomes["read"] += 1
    assert outcomes["refused"] > 0


# ---- images outside the folder


def outside(how, folder, root):
    """A name that leads from a folder of images to another one beside the data set."""
    image = root.parent / f"{root.name}-other" / "x.png"
    image.parent.mkdir()
    Image.new("RGB", (64, 48), (255, 0, 0)).save(image)
    if how == "link":
        (folder / "link.png").symlink_to(image)
    return {"absolute": str(image), "dots": os.path.relpath(image, folder), "link": "link.png"}[how]


# the file that names the images, how it names that of frame 2, and the folder that this is relative to
NAMED = {
    TUM: ("rgb.txt", " rgb/2.png", ""),
    EUROC: ("data.csv", ",{name}", "mav0/cam0/data"),
    COLMAP: ("images.txt", " 0002.png", "images"),
    NERF: ("transforms.json", '"./images/0002', ""),
}


@pytest.mark.parametrize("layout", NAMED)
@pytest.mark.parametrize("how", ["link", "absolute", "dots"])
def test_links_are_followed_and_outside_names_refused(tmp_path, layout, how):
    root = tmp_path / "set"
    root.mkdir()
    folder = WRITERS[layout](root)
    file, name, base = NAMED[layout]
    path = next(root.rglob(file))
    name = name.format(name=read_recording(folder).image_paths[2].name)
    path.write_text(path.read_text().replace(name, name[0] + outside(how, folder / base, root)))
    if layout is COLMAP:  # where a picture that is not named is a frame without a pose
        (folder / "images" / "0002.png").unlink()
    if how != "link":
        with pytest.raises(DatasetError, match=rf"{file}: names .*x\.png.*outside"):
            read_recording(folder)
        return
    recording = read_recording(folder)
    assert 255 in [recording.image(i)[0, 0, 0] for i in range(N)]
