"""Cameras that are none are refused by file and field, unlikely ones are told, in every layout."""

import json
import warnings

import numpy as np
import pytest

from conformodal.datasets import DatasetError, DatasetWarning, Layout, read_sequence
from conformodal.datasets.cameras import camera_beside
from conformodal.datasets.streams.bag import BagStream
from conformodal.datasets.streams.frames import SourceError
from conformodal.poses import PinholeCamera, PoseError
from tests.datasets.streams import test_streams
from tests.datasets.test_layouts import SIZE, WRITERS
from tests.helpers import invoke

LENS = (-0.1, 0.02, 0.001, 0.002)
MATRIX = (Layout.SEVENSCENES, Layout.RGBD_SCENES, Layout.TUM, Layout.IMAGES)
NAN, INF = float("nan"), float("inf")


def yaml_number(value):
    return {"nan": ".nan", "inf": ".inf", "-inf": "-.inf"}.get(repr(float(value)), repr(float(value)))


def write_camera(layout, root, pixels, lens=()):
    """Write a camera into a data set of a layout; returns the name of its file."""
    fx, fy, cx, cy = pixels
    if layout in MATRIX:
        path = max(root.rglob("camera-intrinsics.txt"))
        path.write_text(f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")
        if lens:
            path.with_name("camera-distortion.txt").write_text(" ".join(map(str, lens)))
    elif layout is Layout.KITTI:
        path = next(root.rglob("calib.txt"))
        path.write_text(f"P0: {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0\n")
    elif layout is Layout.EUROC:
        path = next(root.rglob("sensor.yaml"))
        keep = [x for x in path.read_text().splitlines() if not x.startswith(("intrinsics", "distortion_coeff"))]
        keep.append(f"intrinsics: [{', '.join(map(yaml_number, pixels))}]")
        keep.append(f"distortion_coefficients: [{', '.join(map(yaml_number, lens or (0, 0, 0, 0)))}]")
        path.write_text("\n".join(keep))
    elif layout is Layout.COLMAP:
        path = next(root.rglob("cameras.txt"))
        numbers = " ".join(map(str, (*pixels, *(lens or (0, 0, 0, 0)))))
        path.write_text(f"3 OPENCV {SIZE[0]} {SIZE[1]} {numbers}\n")
    else:
        path = root / "transforms.json"
        numbers = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), (*pixels, *lens), strict=False))
        change_json(path, numbers)
    return path.name


def change_json(path, changes, frame=None):
    content = json.loads(path.read_text())
    (content if frame is None else content["frames"][frame]).update(changes)
    path.write_text(json.dumps(content))


# what: (fx, fy, cx, cy, lens), in images of 64x48
NO_CAMERA = {
    "fx is NaN": (NAN, 40, 32, 24, ()),
    "fx is infinite": (INF, 40, 32, 24, ()),
    "fx is negative": (-40, 40, 32, 24, ()),
    "fy is zero": (40, 0, 32, 24, ()),
    "cx is NaN": (40, 40, NAN, 24, ()),
    "cy is infinite": (40, 40, 32, INF, ()),
    "cx is a million millions": (40, 40, 1e12, 24, ()),
    "fx sees 179 degrees": (0.5, 40, 32, 24, ()),
    "fx sees a thousandth of a degree": (1e7, 40, 32, 24, ()),
    "fy overflows": (40, 1e400, 32, 24, ()),
    "k1 is 1e9": (40, 40, 32, 24, (1e9, 0, 0, 0)),
    "p2 is 1e9": (40, 40, 32, 24, (0, 0, 0, 1e9)),
    "k2 is NaN": (40, 40, 32, 24, (0, NAN, 0, 0)),
}
UNLIKELY = {
    "principal point right of the image": ((40, 40, 640, 24, ()), "principal point .* outside"),
    "principal point above the image": ((40, 40, 32, -5, ()), "principal point .* outside"),
    "intrinsics of ten times the size": ((400, 400, 320, 240, ()), "fit images of about 640x480"),
    "intrinsics of half the size": ((20, 20, 16, 12, ()), "images of about 32x24"),
    "fx twice fy": ((80, 40, 32, 24, ()), "fx = 80 and fy = 40"),
    "a view of 145 degrees": ((10, 10, 32, 24, ()), "field of view of 145"),
    "a view of two degrees": ((2000, 2000, 32, 24, ()), "field of view of 1.83"),
    "a lens that folds the image": ((40, 40, 32, 24, (-2.0, 0, 0, 0)), "folds"),
}


def has_lens(layout, lens):
    return layout is not Layout.KITTI or not lens


@pytest.mark.parametrize(
    ("layout", "what"), [(a, w) for a in WRITERS for w in NO_CAMERA if has_lens(a, NO_CAMERA[w][4])]
)
def test_what_is_no_camera_is_refused_by_file(tmp_path, layout, what):
    folder = WRITERS[layout](tmp_path)
    *pixels, lens = NO_CAMERA[what]
    name = write_camera(layout, tmp_path, pixels, lens)
    with pytest.raises(DatasetError) as caught:
        read_sequence(folder, layout, require_poses=len(what) % 2 == 0)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("layout", "what"), [(a, w) for a in WRITERS for w in UNLIKELY if has_lens(a, UNLIKELY[w][0][4])]
)
def test_what_is_unlikely_is_told(tmp_path, layout, what):
    folder = WRITERS[layout](tmp_path)
    (*pixels, lens), match = UNLIKELY[what]
    name = write_camera(layout, tmp_path, pixels, lens)
    with pytest.warns(DatasetWarning, match=match):
        sequence = read_sequence(folder, layout)
    assert (sequence.camera.fx, sequence.camera.cy) == (pixels[0], pixels[3])
    assert any(name in where for _, where in sequence.notes)


@pytest.mark.parametrize("layout", WRITERS)
def test_sound_cameras_are_not_remarked(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    write_camera(layout, tmp_path, (41.0, 40.0, 33.0, 23.0), () if layout is Layout.KITTI else LENS)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        assert read_sequence(folder, layout).notes == ()


MATRICES = {
    "transposed": ("40 0 0\n0 40 0\n32 24 1\n", "transposed"),
    "identity": ("1 0 0\n0 1 0\n0 0 1\n", "identity"),
    "last row": ("40 0 32\n0 40 24\n0 0 2\n", "expected rows"),
    "all zeros": ("0 0 0\n0 0 0\n0 0 0\n", "expected rows"),
    "inverse": ("0.025 0 -0.8\n0 0.025 -0.6\n0 0 1\n", "field of view"),
    "skew": ("40 5 32\n0 40 24\n0 0 1\n", "expected rows"),
    "turned": ("40 0 32\n7 40 24\n0 0 1\n", "expected rows"),
    "NaN in a place of zero": ("40 nan 32\n0 40 24\n0 0 1\n", "expected rows"),
    "four numbers": ("40 40 32 24\n", "4 numbers, expected 9"),
    "words": ("fx 0 cx\n0 fy cy\n0 0 1\n", "cannot be read as numbers"),
    "digits with an underscore": ("4_0 0 32\n0 40 24\n0 0 1\n", "cannot be read as numbers"),
    "digits of another script": ("\u0664\u0660 0 32\n0 40 24\n0 0 1\n", "cannot be read as numbers"),
}


@pytest.mark.parametrize("what", MATRICES)
@pytest.mark.parametrize("layout", MATRIX)
def test_matrices_that_are_no_camera_are_refused(tmp_path, layout, what):
    folder = WRITERS[layout](tmp_path)
    content, match = MATRICES[what]
    path = max(tmp_path.rglob("camera-intrinsics.txt"))
    path.write_text(content)
    with pytest.raises(DatasetError, match=f"camera-intrinsics.*{match}"):
        read_sequence(folder, layout)
    with pytest.raises(DatasetError, match=f"camera-intrinsics.*{match}"):  # as --camera of data convert
        camera_beside(path.parent, SIZE, None)


@pytest.mark.parametrize("layout", [Layout.COLMAP, Layout.EUROC, Layout.NERF])
@pytest.mark.parametrize(
    ("size", "pixels", "scaled"),
    [
        ((640, 480), (400, 400, 320, 240), True),
        ((32, 24), (20, 20, 16, 12), True),
        ((640, 640), (400, 400, 320, 320), False),
        ((48, 64), (40, 40, 24, 32), False),
        ((0, 0), (40, 40, 32, 24), False),
    ],
)
def test_a_size_that_the_file_states_scales_its_camera_or_refuses(tmp_path, layout, size, pixels, scaled):
    folder = WRITERS[layout](tmp_path)
    if layout is Layout.COLMAP:
        path = next(tmp_path.rglob("cameras.txt"))
        path.write_text(f"3 PINHOLE {size[0]} {size[1]} {' '.join(map(str, pixels))}\n")
    elif layout is Layout.EUROC:
        path = next(tmp_path.rglob("sensor.yaml"))
        text = path.read_text().replace("resolution: [64, 48]", f"resolution: {list(size)}")
        path.write_text(text.replace("[40, 40, 32, 24]", str(list(pixels))))
    else:
        numbers = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h"), (*pixels, *size), strict=True))
        change_json(tmp_path / "transforms.json", numbers)
    if not scaled:
        with pytest.raises(DatasetError, match=f"for {size[0]}x{size[1]} pixels"):
            read_sequence(folder)
        return
    with pytest.warns(DatasetWarning, match=f"scaled from {size[0]}x{size[1]}"):
        camera = read_sequence(folder).camera
    assert (camera.fx, camera.cx, camera.cy, camera.width) == pytest.approx((40, 32, 24, 64))


def of_kitti(row):
    return Layout.KITTI, lambda root: next(root.rglob("calib.txt")).write_text(f"{row}\n")


def of_colmap(camera):
    return Layout.COLMAP, lambda root: next(root.rglob("cameras.txt")).write_text(f"3 {camera}\n")


def of_nerf(changes, frame=None):
    return Layout.NERF, lambda root: change_json(root / "transforms.json", changes, frame)


def of_euroc(model):
    def change(root):
        path = next(root.rglob("sensor.yaml"))
        path.write_text(path.read_text().replace("radial-tangential", model))

    return Layout.EUROC, change


OTHER_MODELS = [
    *[
        (of_colmap(f"{model} 64 48 40 40 32 24 0.1 0.1 0.1 0.1"), rf"cameras\.txt, line 1: .*{model} .*undistort")
        for model in ("THIN_PRISM_FISHEYE", "FOV")
    ],
    *[
        (of_colmap(f"FULL_OPENCV 64 48 40 40 32 24 0.1 0 0 0 0.01 {lens}"), "line 1: .*FULL_OPENCV .*undistort")
        for lens in ("0.1 0 0", "0 0.1 0", "0 0 0.1")
    ],
    *[
        (of_colmap(numbers), r"cameras\.txt, line 1: is no camera")
        for numbers in (
            "FULL_OPENCV 64 48 40 40 32 24 0 0 0 0 0", "PINHOLE 64 48 40 40 32 24 1", "OPENCV 64 48 40 40 32 24",
            "RADIAL 64 48 40",
        )
    ],
    *[
        (of_nerf(changes), r"transforms\.json: .*undistort")
        for changes in (
            {"camera_model": "EQUIRECTANGULAR"}, {"camera_model": ["OPENCV"]},
            {"camera_model": "OPENCV", "is_fisheye": True}, {"k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1},
        )
    ],
    *[
        (of_nerf(own, frame=2), r"transforms\.json: .*(camera_model FISHEYE|'h')")
        for own in ({"w": 128}, {"camera_model": "FISHEYE"})
    ],
    *[(of_euroc(m), rf"sensor\.yaml: .*{m}.*undistort") for m in ("none", "kannala-brandt")],
    (of_kitti("P0: 40 0 0 0 0 40 0 0 32 24 1 0"), r"calib\.txt.*P0.*transposed"),
    (of_kitti("P0: 1 0 0 0 0 1 0 0 0 0 1 0"), r"calib\.txt.*P0.*identity"),
    (of_kitti("P0: 40 0 32 0 0 40 24 0 0 0 0 0"), r"calib\.txt.*P0.*expected rows"),
    (of_kitti("P0: 40 0 32 0 0 40 24 0 0 0 1 nan"), r"calib\.txt.*P0.*twelve numbers"),
    (of_kitti("P0: 40 0 32 0 0 40 24 0 0 0 1 0 0"), r"calib\.txt.*P0.*twelve numbers"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "match"), OTHER_MODELS)
def test_cameras_that_are_no_pinhole_are_refused_by_file(tmp_path, change, match):
    layout, spoil = change
    folder = WRITERS[layout](tmp_path)
    spoil(tmp_path)
    with pytest.raises(DatasetError, match=match):
        read_sequence(folder)


@pytest.mark.parametrize(
    ("change", "lens"),
    [
        (of_colmap("FULL_OPENCV 64 48 40 40 32 24 0.1 0 0 0 0.01 0 0 0"), (0.1, 0, 0, 0, 0.01)),
        (of_nerf({"k1": 0.1, "k3": 0.03}), (0.1, 0.0, 0.0, 0.0, 0.03)),
    ],
)
def test_the_fifth_number_of_a_lens_is_k3(tmp_path, change, lens):
    layout, write = change
    WRITERS[layout](tmp_path)
    write(tmp_path)
    assert read_sequence(tmp_path).camera.distortion == lens


@pytest.mark.parametrize("broken", ["1.0, 0.0, 0.0, 0.1", "2.0, 0, 0, 0", ".nan, 0, 0, 0"])
def test_a_euroc_mounting_that_is_no_rigid_motion_is_refused(tmp_path, broken):
    WRITERS[Layout.EUROC](tmp_path)
    path = next(tmp_path.rglob("sensor.yaml"))
    text = path.read_text()
    start = text.index("data: [") + len("data: [")
    path.write_text(text[:start] + broken + "," + text[start:].split(",", 4)[4])
    with pytest.raises(DatasetError, match=r"sensor\.yaml"):
        read_sequence(tmp_path)


@pytest.mark.parametrize(
    ("k", "model", "match"),
    [
        ([40, 0, 32, 0, NAN, 24, 0, 0, 1], "plumb_bob", "expected rows"),
        ([0] * 9, "plumb_bob", "expected rows"),
        ([40, 0, 0, 0, 40, 0, 32, 24, 1], "plumb_bob", "transposed"),
        ([1, 0, 0, 0, 1, 0, 0, 0, 1], "plumb_bob", "identity"),
        ([-40, 0, 32, 0, 40, 24, 0, 0, 1], "plumb_bob", "fx = -40"),
        ([40, 0, 32, 0, 40, 24, 0, 0, 1], "equidistant", "undistort"),
    ],
)
def test_bags_with_a_camera_that_is_none_are_refused(tmp_path, monkeypatch, k, model, match):
    made = test_streams.camera_info

    def info(store, head):
        message = made(store, head)
        object.__setattr__(message, "k" if hasattr(message, "k") else "K", np.array(k, dtype=float))
        object.__setattr__(message, "distortion_model", model)
        return message

    monkeypatch.setattr(test_streams, "camera_info", info)
    path = test_streams.write_bag(tmp_path / "a", "ros2")
    with pytest.raises(SourceError, match=match):
        BagStream(path)


@pytest.mark.parametrize("field", ["fx", "fy", "cx", "cy", "width", "height"])
@pytest.mark.parametrize("value", [NAN, INF, -INF, None, "40"])
def test_a_camera_refuses_what_is_no_finite_number(field, value):
    good = {"fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    with pytest.raises(PoseError, match=f"camera has {field} = "):
        PinholeCamera(**(good | {field: value}))


@pytest.mark.parametrize(
    ("pixels", "code", "said"),
    [((40, 40, 1e12, 24), 2, "error:"), ((400, 400, 320, 240), 1, "camera is unlikely")],
)
def test_the_command_says_it_in_a_line(tmp_path, pixels, code, said):
    folder = WRITERS[Layout.COLMAP](tmp_path)
    write_camera(Layout.COLMAP, tmp_path, pixels)
    result = invoke("data", "check", folder)
    assert result.exit_code == code, result.output
    assert said in result.output
    assert "nothing is wrong" not in result.output
