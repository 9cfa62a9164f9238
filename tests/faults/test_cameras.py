"""Cameras that are none are refused by file and field, unlikely ones are told, in every layout."""

import warnings

import numpy as np
import pytest

from conformodal.geometry import PinholeCamera, PoseError
from conformodal.io import DatasetError, DatasetWarning, Layout, read_recording
from conformodal.io.streams.frames import SourceError
from conformodal.io.streams.opening import open_stream
from tests.helpers import invoke
from tests.io.streams import test_streams
from tests.io.test_layouts import SIZE, WRITERS
from tests.io.test_refusals import colmap_camera, nerf

LENS = (-0.1, 0.02, 0.001, 0.002)
MATRIX = (Layout.SEVENSCENES, Layout.RGBD_SCENES, Layout.TUM, Layout.IMAGES)
NAN, INF = float("nan"), float("inf")


def yaml_number(value):
    return {"nan": ".nan", "inf": ".inf", "-inf": "-.inf"}.get(repr(float(value)), repr(float(value)))


def write_camera(layout, root, pixels, lens=(), size=SIZE):
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
        keep = [x for x in path.read_text().splitlines() if not x.startswith(("intri", "distortion_coeff", "resol"))]
        keep += [f"resolution: {list(size)}", f"intrinsics: [{', '.join(map(yaml_number, pixels))}]"]
        keep.append(f"distortion_coefficients: [{', '.join(map(yaml_number, lens or (0, 0, 0, 0)))}]")
        path.write_text("\n".join(keep))
    elif layout is Layout.COLMAP:
        path = next(root.rglob("cameras.txt"))
        colmap_camera(f"OPENCV {size[0]} {size[1]} {' '.join(map(str, (*pixels, *(lens or (0, 0, 0, 0)))))}")(root)
    else:
        path = root / "transforms.json"
        names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")
        nerf(dict(zip(names, (*pixels, *size, *lens), strict=False)))(root)
    return path.name


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
        read_recording(folder, layout, require_poses=len(what) % 2 == 0)
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
        sequence = read_recording(folder, layout)
    assert (sequence.camera.fx, sequence.camera.cy) == (pixels[0], pixels[3])
    assert any(name in where for _, where in sequence.notes)


@pytest.mark.parametrize("layout", WRITERS)
def test_sound_cameras_are_not_remarked(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    write_camera(layout, tmp_path, (41.0, 40.0, 33.0, 23.0), () if layout is Layout.KITTI else LENS)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        assert read_recording(folder, layout).notes == ()


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
    write_camera(layout, tmp_path, pixels, size=size)
    if not scaled:
        with pytest.raises(DatasetError, match=f"for {size[0]}x{size[1]} pixels"):
            read_recording(folder)
        return
    with pytest.warns(DatasetWarning, match=f"scaled from {size[0]}x{size[1]}"):
        camera = read_recording(folder).camera
    assert (camera.fx, camera.cx, camera.cy, camera.width) == pytest.approx((40, 32, 24, 64))


@pytest.mark.parametrize(
    ("layout", "write", "lens"),
    [
        (Layout.COLMAP, colmap_camera("FULL_OPENCV 64 48 40 40 32 24 0.1 0 0 0 0.01 0 0 0"), (0.1, 0, 0, 0, 0.01)),
        (Layout.NERF, nerf({"k1": 0.1, "k3": 0.03}), (0.1, 0.0, 0.0, 0.0, 0.03)),
    ],
)
def test_the_fifth_number_of_a_lens_is_k3(tmp_path, layout, write, lens):
    WRITERS[layout](tmp_path)
    write(tmp_path)
    assert read_recording(tmp_path).camera.distortion == lens


@pytest.mark.parametrize(
    ("k", "model", "match"),
    [
        ([40, 0, 32, 0, NAN, 24, 0, 0, 1], "plumb_bob", "expected rows"),
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
        open_stream(path)


@pytest.mark.parametrize("field", ["fx", "fy", "cx", "cy", "width", "height"])
def test_a_camera_refuses_what_is_not_a_finite_number(field):
    good = {"fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    for value in (NAN, INF, -INF, None, "40"):
        with pytest.raises(PoseError, match=f"camera has {field} = "):
            PinholeCamera(**(good | {field: value}))


@pytest.mark.parametrize(
    ("pixels", "code", "said"), [((40, 40, 1e12, 24), 2, "error:"), ((400, 400, 320, 240), 1, "camera is unlikely")]
)
def test_the_command_says_it_in_a_line(tmp_path, pixels, code, said):
    folder = WRITERS[Layout.COLMAP](tmp_path)
    write_camera(Layout.COLMAP, tmp_path, pixels)
    result = invoke("data", "check", folder)
    assert result.exit_code == code, result.output
    assert said in result.output
    assert "nothing is wrong" not in result.output
