"""Data sets that are refused, each by its file: one row per layout, change of one file, and what is said of it."""

import json

import pytest

from conformodal.io import DatasetError, Layout, read_recording
from conformodal.io.cameras import camera_beside
from tests.io.test_layouts import SIZE, WRITERS, N, picture

SEVEN, RGBD, KITTI, TUM = Layout.SEVENSCENES, Layout.RGBD_SCENES, Layout.KITTI, Layout.TUM
EUROC, COLMAP, NERF, IMAGES = Layout.EUROC, Layout.COLMAP, Layout.NERF, Layout.IMAGES


def file_of(root, name):
    return max(p for p in root.rglob("*") if str(p).endswith("/" + name))


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


def colmap_camera(text):
    return put("cameras.txt", f"3 {text}\n")


def without_points(root):
    path = file_of(root, "images.txt")
    path.write_text("\n".join(x for x in path.read_text().splitlines() if x.startswith("#") or x.endswith(".png")))


def then(*changes):
    return lambda root: [change(root) for change in changes]


def blank_line(name):
    def change(root):
        lines = file_of(root, name).read_text().splitlines()
        put(name, "\n".join([*lines[:3], "", *lines[3:]]) + "\n")(root)

    return change


POINTS = "10.5 11.5 -1 12.0 13.0 44\n"
POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n"
ROWS = [
    (SEVEN, lambda r: picture(r / "seq-1" / "frame-000000.color.png", 25), "seq-0?1: another folder has its number"),
    (SEVEN, lambda r: [p.unlink() for p in r.rglob("*.pose.txt")], r"000000\.pose\.txt: pose is missing \(5 of 5"),
    (SEVEN, drop("camera-intrinsics.txt"), "no camera is known for 64x48.*camera-intrinsics"),
    (SEVEN, lambda r: [p.unlink() for p in r.rglob("frame-0*")], "holds no frame"),
    (SEVEN, add("camera-distortion.txt", "-0.28 0.07\n"), r"camera-distortion\.txt: distortion must be k1"),
    (SEVEN, add("camera-distortion.txt", "wide\n"), r"camera-distortion\.txt: cannot be read as numbers"),
    (RGBD, put("02.pose", "1 0 0 0 0 0 0\n"), r"02\.pose: holds 1 poses.*image 4"),
    (RGBD, put("02.pose", "0 0 0 0 1 1 1\n"), r"02\.pose: pose 0 .*no direction"),
    (RGBD, blank_line("02.pose"), r"02\.pose.*line 4"),
    (KITTI, put("calib.txt", "P1: 1\n"), r"calib\.txt: has no line P0"),
    (KITTI, put("calib.txt", "P0: 40 0 0 0 0 40 0 0 32 24 1 0"), r"calib\.txt.*P0.*transposed"),
    (KITTI, put("calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0"), r"calib\.txt.*P0.*identity"),
    (KITTI, put("calib.txt", "P0: 40 0 32 0 0 40 24 0 0 0 0 0"), r"calib\.txt.*P0.*expected rows"),
    (KITTI, put("calib.txt", "P0: 40 0 32 0 0 40 24 0 0 0 1 nan"), r"calib\.txt.*P0.*twelve numbers"),
    (KITTI, put("calib.txt", "P0: 40 0 32 0 0 40 24 0 0 0 1 0 0"), r"calib\.txt.*P0.*twelve numbers"),
    (KITTI, put("times.txt", "0 1\n"), r"times\.txt: holds 2 times for 5 images"),
    (KITTI, put("times.txt", "5 4 3 2 1\n"), "timestamps must increase"),
    (KITTI, put("07.txt", "1 2 3\n"), r"07\.txt, line 1"),
    (KITTI, put("07.txt", POSES), r"07\.txt.*1 poses, but there are 5"),
    (KITTI, blank_line("07.txt"), r"07\.txt.*line 4"),
    (TUM, put("rgb.txt", "# nothing\n"), r"rgb\.txt: lists no image"),
    (TUM, drop("camera-intrinsics.txt"), "no camera is known for 64x48"),
    (EUROC, put("sensor.yaml", "intrinsics: [1, 2]\n"), r"sensor\.yaml: is no EuRoC"),
    (EUROC, sub("sensor.yaml", "[40, 40, 32, 24]", "'4432'"), r"sensor\.yaml: is no EuRoC .*expected 4 numbers"),
    *[
        (EUROC, sub("sensor.yaml", "radial-tangential", model), rf"sensor\.yaml: .*{model}.*undistort")
        for model in ("none", "kannala-brandt")
    ],
    *[
        (EUROC, sub("sensor.yaml", "data: [", f"data: [{first}, ", 1), r"sensor\.yaml")  # one number too many
        for first in ("1.0", "2.0", ".nan")
    ],
    (EUROC, sub("sensor.yaml", "-1.0", "-1.1", 1), r"sensor\.yaml"),  # not a rotation
    (COLMAP, sub("images.txt", " 3 0002", " 4 0002"), r"images\.txt.*uses camera 4, expected one of \[3\]"),
    (COLMAP, put("images.txt", "# nothing\n"), r"images\.txt.*holds no image"),
    (COLMAP, sub("images.txt", POINTS, "", 1), r"images\.txt, line \d+: expected"),
    (COLMAP, sub("images.txt", POINTS, "10.5 11.5\n", 1), r"images\.txt, line \d+: expected"),
    (COLMAP, sub("images.txt", " 0003.png", ""), r"images\.txt, line \d+: expected"),
    (COLMAP, then(without_points, sub("images.txt", " 0003.png", "")), r"images\.txt, line \d+: expected"),
    (COLMAP, then(without_points, sub("images.txt", " 3 0003.png", "")), r"images\.txt, line \d+: expected"),
    (COLMAP, sub("images.txt", "0003.png", "0002.png"), r"images\.txt.*a second time"),
    (COLMAP, sub("images.txt", "44\n", "44\n1 2 3 4 5 6 7 8 9 10 11 12\n", 1), r"images\.txt, line \d+: expected"),
    (COLMAP, sub("images.txt", " 3 0003", " 3_0 0003"), r"images\.txt, line \d+: expected"),
    (COLMAP, add("times.txt", "1 2 4\n"), r"times\.txt: holds 3 times for 5 images"),
    *[
        (COLMAP, colmap_camera(f"{model} 64 48 40 40 32 24 0.1 0.1 0.1 0.1"), f"line 1: .*{model} .*undistort")
        for model in ("THIN_PRISM_FISHEYE", "FOV")
    ],
    *[
        (COLMAP, colmap_camera(f"FULL_OPENCV 64 48 40 40 32 24 0.1 0 0 0 0.01 {lens}"), "line 1: .*FULL_OPENCV .*undis")
        for lens in ("0.1 0 0", "0 0.1 0", "0 0 0.1")
    ],
    *[
        (COLMAP, colmap_camera(numbers), r"cameras\.txt, line 1: .*parameters")
        for numbers in (
            "FULL_OPENCV 64 48 40 40 32 24 0 0 0 0 0", "PINHOLE 64 48 40 40 32 24 1", "OPENCV 64 48 40 40 32 24",
            "RADIAL 64 48 40",
        )
    ],
    (NERF, lambda r: put("transforms.json", (r / "transforms.json").read_text()[:-20])(r), "is no NeRF file"),
    (NERF, sub("transforms.json", "camera_angle_x", "angle"), r"transforms\.json.*says no camera"),
    (NERF, sub("transforms.json", "/00", "/01"), r"transforms\.json.*no such image"),
    (NERF, sub("transforms.json", "1.0]]", "]]", 1), r"transforms\.json.*is no NeRF file"),
    (NERF, add("times.txt", "1 2 4\n"), r"times\.txt: holds 3 times for 5 images"),
    *[
        (NERF, nerf(changes), r"transforms\.json: .*undistort")
        for changes in (
            {"camera_model": "EQUIRECTANGULAR"}, {"camera_model": ["OPENCV"]},
            {"camera_model": "OPENCV", "is_fisheye": True}, {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1},
        )
    ],
    *[
        (NERF, nerf(own, frame=2), r"transforms\.json: .*(camera_model FISHEYE|'h')")
        for own in ({"w": 128}, {"camera_model": "FISHEYE"})
    ],
    (IMAGES, drop("poses.tum"), r"poses\.tum: poses are missing"),
    *[
        (IMAGES, then(drop("poses.tum"), add("poses.txt", POSES * n)), rf"poses\.txt: .*{n} poses, .*{N} images")
        for n in (N - 1, N + 1)
    ],
    (IMAGES, then(drop("poses.tum"), add("poses.txt", "0 1 2 3 0 0 0 1\n" * N)), "twelve numbers.*poses.tum"),
]  # fmt: skip


@pytest.mark.parametrize(("layout", "change", "match"), ROWS)
def test_a_damaged_data_set_is_refused_by_its_file(tmp_path, layout, change, match):
    folder = WRITERS[layout](tmp_path)
    change(tmp_path)
    with pytest.raises(DatasetError, match=match) as caught:
        read_recording(folder, layout)
    assert "\n" not in str(caught.value)


MATRICES = [
    ("40 0 0\n0 40 0\n32 24 1\n", "transposed"),
    ("1 0 0\n0 1 0\n0 0 1\n", "identity"),
    ("40 0 32\n0 40 24\n0 0 2\n", "expected rows"),
    ("0 0 0\n0 0 0\n0 0 0\n", "expected rows"),
    ("0.025 0 -0.8\n0 0.025 -0.6\n0 0 1\n", "field of view"),
    ("40 5 32\n0 40 24\n0 0 1\n", "expected rows"),
    ("40 0 32\n7 40 24\n0 0 1\n", "expected rows"),
    ("40 nan 32\n0 40 24\n0 0 1\n", "expected rows"),
    ("40 40 32\n", "3 numbers, expected 9"),
    ("fx 0 cx\n0 fy cy\n0 0 1\n", "cannot be read as numbers"),
    ("4_0 0 32\n0 40 24\n0 0 1\n", "cannot be read as numbers"),
    ("\u0664\u0660 0 32\n0 40 24\n0 0 1\n", "cannot be read as numbers"),
]


@pytest.mark.parametrize(("content", "match"), MATRICES)
def test_matrices_that_are_not_a_camera_are_refused(tmp_path, content, match):
    for layout in (SEVEN, RGBD, TUM, IMAGES):
        (tmp_path / layout).mkdir()
        folder = WRITERS[layout](tmp_path / layout)
        path = file_of(tmp_path / layout, "camera-intrinsics.txt")
        path.write_text(content)
        for read in (lambda: read_recording(folder, layout), lambda: camera_beside(path.parent, SIZE, None)):  # noqa: B023
            with pytest.raises(DatasetError, match=f"camera-intrinsics.*{match}"):
                read()
