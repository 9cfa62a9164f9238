"""Bytes in, a typed error or a valid object out: every parser, with valid files that were changed."""

import io
import json
import os
import resource
import struct
import time
import zlib
from contextlib import contextmanager

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from conformodal.conformal import ConformodalError
from conformodal.io import Layout, read_image, read_recording
from conformodal.io.streams.opening import open_stream
from tests.io.test_layouts import WRITERS, N

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning", "error::RuntimeWarning")

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
TOKENS = [
    b"nan", b"-inf", b"1e400", b"-1e308", b"1_0", "\u0663".encode(), b"0x10", b"9" * 30, b"9" * 5000, b"\0", b"\xff",
    b"\xef\xbb\xbf", b"\r", b"\n", b"\n\n", b"#", b",", b" ", b"-", b".", b"..", b"/etc/passwd", b"~", b"&a", b"*a",
    b"!!python/object/apply:os.system [ls]", b"{", b"}", b"[", b"]", b'"', b"null", b"true", b"[" * 20_000,
    b'{"a":' * 20_000, b"1 " * 50_000, b"x" * 99_999, b"---", b": ", b"| ", b"\xe2\x80\xa8", b"\x0c", b"0", b"-1",
    b"1e18",
]  # fmt: skip
PLACE = st.floats(0, 1, exclude_max=True)
# a few places, as shares of the length, and what happens there
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("flip"), PLACE, st.integers(0, 255)),
        st.tuples(st.sampled_from(["cut", "repeat"]), PLACE, st.integers(1, 200)),
        st.tuples(st.just("end"), PLACE, st.just(0)),
        st.tuples(st.just("insert"), PLACE, st.sampled_from(TOKENS)),
    ),
    min_size=1,
    max_size=4,
)
QUICK = settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "8")),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


def changed(content, changes):
    for kind, share, value in changes:
        at = int(share * len(content))
        if kind == "flip":
            content = content[:at] + bytes([value]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at] + content[at + value :]
        elif kind == "repeat":
            content = content[: at + value] + content[at:]
        elif kind == "insert":
            content = content[:at] + value + content[at:]
        else:
            content = content[:at]
    return content


def soundly(read):
    """Run a parser; it may refuse, within a second (ten on a slow machine with other work)."""
    begun = time.process_time()
    try:
        return read()
    except ConformodalError as exc:
        assert 0 < len(str(exc)) < 5000  # noqa: PT017
        return None
    finally:
        assert time.process_time() - begun < 10


def valid(recording):
    assert 1 <= len(recording) <= 2 * N
    assert np.isfinite(recording.timestamps_s).all()
    assert (np.diff(recording.timestamps_s) > 0).all()
    assert np.isfinite(recording.camera.matrix).all()
    assert min(recording.camera.fx, recording.camera.fy) > 0
    if recording.poses is not None:
        assert np.isfinite(recording.poses.poses_se3).all()
        assert np.abs(recording.poses.positions_xyz).max() < 1e10
    assert recording.truth is None or len(recording.truth) == len(recording)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folders = {}
    for layout, write in WRITERS.items():
        root = tmp_path_factory.mktemp(layout.replace("-", "")) / "root"
        root.mkdir()
        folders[layout] = root, write(root)
    return folders


def read_changed(sets, layout, name, change, **options):
    """A data set with one file changed is valid or refused."""
    root, folder = sets[layout]
    path = max(p for p in root.rglob("*") if str(p).endswith(name))
    content = path.read_bytes()
    try:
        path.write_bytes(change(content))
        recording = soundly(lambda: read_recording(folder, layout, **options))
    finally:
        path.write_bytes(content)
    if recording is not None:
        valid(recording)


@pytest.mark.parametrize(("layout", "name"), [(layout, name) for layout, names in FILES.items() for name in names])
@QUICK
@given(changes=CHANGES, require_poses=st.booleans())
def test_data_sets(sets, layout, name, changes, require_poses):
    read_changed(sets, layout, name, lambda content: changed(content, changes), require_poses=require_poses)


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=9), st.sampled_from([10**400, "images/0001"])
)
TREES = st.recursive(SCALARS, lambda t: st.one_of(st.lists(t, max_size=4), st.dictionaries(st.text(max_size=5), t)))
NERF = [(k,) for k in ("frames", "fl_x", "fl_y", "cx", "w", "k1", "k4", "camera_model", "is_fisheye", "camera_angle_x")]
NERF += [("frames", 1, "file_path"), ("frames", 1, "transform_matrix")]
NERF += [("frames", 1, "transform_matrix", 1), ("frames", 1, "transform_matrix", 1, 2)]
EUROC = [("intrinsics",), ("distortion_coefficients",), ("T_BS",), ("resolution",), ("camera_model",), ("T_BS", "data")]


@pytest.mark.parametrize(
    ("layout", "name", "load", "dump", "keys"),
    [
        (Layout.NERF, "transforms.json", json.loads, json.dumps, NERF),
        (Layout.EUROC, "sensor.yaml", yaml.safe_load, yaml.safe_dump, EUROC),
    ],
    ids=["nerf", "euroc"],
)
@settings(QUICK, max_examples=30)
@given(draw=st.data(), value=TREES)
def test_trees_of_another_shape(sets, layout, name, load, dump, keys, draw, value):
    *way, last = draw.draw(st.sampled_from(keys))

    def change(content):
        tree = inner = load(content)
        for key in way:
            inner = inner[key]
        inner[last] = value
        return dump(tree).encode()

    read_changed(sets, layout, name, change)


def saved(kind):
    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
    if kind == "grey16":
        image = Image.fromarray(rng.integers(0, 65535, (24, 32), dtype=np.uint16))
    stream = io.BytesIO()
    image.save(stream, format={"grey16": "PNG"}.get(kind, kind.upper()))
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["png", "grey16", "jpeg", "tiff", "bmp", "webp", "gif", "ppm"])
@QUICK
@given(changes=CHANGES)
def test_images(tmp_path_factory, kind, changes):
    path = tmp_path_factory.getbasetemp() / "a.png"
    path.write_bytes(changed(saved(kind), changes))
    image = soundly(lambda: read_image(path))
    if image is not None:
        assert (image.dtype, image.shape[2:]) == (np.uint8, (3,))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    pytest.importorskip("rosbags")
    from tests.io.streams.test_streams import write_bag

    root = tmp_path_factory.mktemp("bags")
    mcap = write_bag(root / "m", "mcap")
    return {".bag": write_bag(root / "a.bag", "ros1").read_bytes(), ".mcap": next(mcap.glob("*.mcap")).read_bytes()}


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
@QUICK
@given(changes=CHANGES)
def test_bags(tmp_path_factory, bags, suffix, changes):
    path = tmp_path_factory.mktemp("bag") / f"a{suffix}"
    path.write_bytes(changed(bags[suffix], changes))
    frames = soundly(lambda: list(open_stream(path)))
    if frames is not None:
        assert all(frame.image is None or frame.image.dtype == np.uint8 for frame in frames)


LARGE = {
    "deep JSON": (Layout.NERF, "transforms.json", b"[" * 900_000),
    "a JSON number of many digits": (Layout.NERF, "transforms.json", b'{"frames": ' + b"9" * 900_000 + b"}"),
    "deep YAML": (Layout.EUROC, "sensor.yaml", b"[" * 900_000),
    "YAML that multiplies": (
        Layout.EUROC,
        "sensor.yaml",
        b"a0: &a0 [1,1,1,1,1,1,1,1,1]\n"
        + b"".join(b"a%d: &a%d [%s]\n" % (k, k, b",".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 12))
        + b"T_BS: {data: *a11}\nintrinsics: *a11\n",
    ),
    "YAML that holds itself": (Layout.EUROC, "sensor.yaml", b"intrinsics: &a [*a, *a, *a, *a]\nT_BS: {data: *a}\n"),
    "a YAML object": (Layout.EUROC, "sensor.yaml", b"!!python/object/apply:os.getcwd []\n"),
    "one long line of images": (Layout.TUM, "rgb.txt", b"1 " + b"a" * 990_000),
    "many damaged poses": (Layout.TUM, "groundtruth.txt", b"x\n" * 20_000 + b"100 0 0 0 0 0 0 1\n"),
}


@contextmanager
def little_memory():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


@pytest.mark.parametrize("what", LARGE)
def test_large_and_hostile_texts(sets, what):
    layout, name, hostile = LARGE[what]
    with little_memory():
        read_changed(sets, layout, name, lambda _: hostile)


def png_of(width, height, colour, bits):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    size = max(1, width * height * bits * (3 if colour == 2 else 1) // 8 + height)
    return (
        b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(min(size, 1 << 24)), 9)) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("size", "refused"),
    [
        ((2000, 2000, 2, 8), False),
        ((10_000, 10_000, 0, 1), True),
        ((60_000, 60_000, 0, 1), True),
        ((2_000_000_000, 1, 0, 1), True),
        ((0, 0, 2, 8), True),
    ],
)
def test_small_files_that_claim_many_pixels(tmp_path, size, refused):
    (tmp_path / "a.png").write_bytes(png_of(*size))
    with little_memory():
        image = soundly(lambda: read_image(tmp_path / "a.png"))
    assert (image is None) == refused
