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
    Layout.SEVENSCENES: ("frame-000002.pose.txt", "camera-intrinsics.txt", "frame-rate.txt", "TrainSplit.txt"),
    Layout.RGBD_SCENES: ("02.pose",),
    Layout.KITTI: ("calib.txt", "times.txt", "07.txt"),
    Layout.TUM: ("rgb.txt", "groundtruth.txt", "camera-distortion.txt"),
    Layout.EUROC: ("sensor.yaml", "cam0/data.csv", "estimate0/data.csv"),
    Layout.COLMAP: ("cameras.txt", "images.txt"),
    Layout.NERF: ("transforms.json",),
    Layout.IMAGES: ("poses.tum", "times.txt"),
}
ROWS = [(layout, name) for layout, names in FILES.items() for name in names]

TOKENS = [
    b"nan", b"-inf", b"Infinity", b"1e400", b"-1e308", b"1e-400", b"1_0", "\u0663".encode(), "\uff11".encode(), b"0x10",
    b"9" * 30, b"9" * 5000, b"\0", b"\xff", b"\xef\xbb\xbf", b"\r", b"\n", b"\n\n", b"#", b",", b" ", b"\t", b"-", b"+",
    b".", b"..", b"/", b"/etc/passwd", b"~", b"*", b"&a", b"*a", b"!!python/object/apply:os.system [ls]", b"%", b"{",
    b"}", b"[", b"]", b'"', b"null", b"true", b"{}", b"[]", b"[" * 20_000, b'{"a":' * 20_000, b"1 " * 50_000,
    b"x" * 99_999,
    b"---", b"? ", b": ", b"| ", b"1e", b"\xe2\x80\xa8", b"\x85", b"\x0c", b"0", b"1", b"-1", b"2", b"1e18", b"1e-18",
]  # fmt: skip


PLACE = st.floats(0, 1, exclude_max=True)
# a few places, as shares of the length, and what happens there
CHANGES = st.lists(
    st.one_of(
        st.tuples(st.just("flip"), PLACE, st.integers(0, 255)),
        st.tuples(st.sampled_from(["cut", "repeat"]), PLACE, st.integers(1, 200)),
        st.tuples(st.just("end"), PLACE, st.just(0)),
        st.tuples(st.sampled_from(["insert", "replace"]), PLACE, st.sampled_from(TOKENS)),
    ),
    min_size=1,
    max_size=4,
)


def changed(content, what):
    for kind, share, value in what:
        at = int(share * len(content))
        if kind == "flip":
            content = content[:at] + bytes([value]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at] + content[at + value :]
        elif kind == "end":
            content = content[:at]
        elif kind == "insert":
            content = content[:at] + value + content[at:]
        elif kind == "replace":  # the word that is there
            end = at
            while end < len(content) and content[end : end + 1] not in b" ,\n]":
                end += 1
            content = content[:at] + value + content[end:]
        else:
            content = content[: at + value] + content[at:]
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


def valid(sequence):
    assert 1 <= len(sequence) <= 2 * N
    assert np.isfinite(sequence.timestamps_s).all()
    assert (np.diff(sequence.timestamps_s) > 0).all()
    camera = sequence.camera
    assert np.isfinite(camera.matrix).all()
    assert min(camera.fx, camera.fy) > 0
    for poses in (sequence.truth, sequence.known_poses):
        if poses is not None:
            assert np.isfinite(poses.poses_se3).all()
            assert np.abs(poses.positions_xyz).max() < 1e10
    assert sequence.truth is None or len(sequence.truth) == len(sequence)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    found = {}
    for layout, write in WRITERS.items():
        root = tmp_path_factory.mktemp(layout.replace("-", "")) / "root"
        root.mkdir()
        folder = write(root)
        if layout is Layout.SEVENSCENES:
            second = root / "seq-02"
            second.mkdir()
            Image.new("RGB", (64, 48)).save(second / "frame-000000.color.png")
            np.savetxt(second / "frame-000000.pose.txt", np.eye(4))
            (root / "TrainSplit.txt").write_text("sequence1\n")
            (root / "TestSplit.txt").write_text("sequence2\n")
        if layout is Layout.TUM:
            (folder / "camera-distortion.txt").write_text("-0.1 0.02 0.001 0.002\n")
        if layout is Layout.IMAGES:
            for i, path in enumerate(sorted(folder.glob("*.png"))):
                path.rename(folder / f"{i}.png")
            (folder / "times.txt").write_text("\n".join(f"{100 + 0.1 * i}" for i in range(N)))
        found[layout] = root, folder
    return found


QUICK = settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "8")),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


@contextmanager
def kept(path):
    """What a file holds, which it holds again afterwards."""
    content = path.read_bytes()
    try:
        yield content
    finally:
        path.write_bytes(content)


def read_changed(sets, layout, name, change, **options):
    """A data set with one file changed is valid or refused."""
    root, folder = sets[layout]
    path = max(p for p in root.rglob("*") if str(p).endswith(name))
    with kept(path) as content:
        path.write_bytes(change(content))
        sequence = soundly(lambda: read_recording(folder, layout, **options))
    if sequence is not None:
        valid(sequence)


@pytest.mark.parametrize(("layout", "name"), ROWS)
@QUICK
@given(what=CHANGES, require_poses=st.booleans())
def test_data_sets(sets, layout, name, what, require_poses):
    read_changed(sets, layout, name, lambda content: changed(content, what), require_poses=require_poses)


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
@QUICK
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


def pictures():
    rng = np.random.default_rng(0)
    image = Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 1
    made = {
        "png": (image, {"exif": exif.tobytes()}),
        "palette": (image.quantize(16), {"transparency": 3, "format": "PNG"}),
        "grey16": (Image.fromarray(rng.integers(0, 65535, (24, 32), dtype=np.uint16)), {"format": "PNG"}),
        "jpeg": (image, {"exif": exif.tobytes()}),
        "tiff": (image, {"compression": "tiff_lzw"}),
        **{kind: (image, {}) for kind in ("bmp", "webp", "gif", "ppm")},
    }
    for name, (picture, options) in made.items():
        stream = io.BytesIO()
        picture.save(stream, **({"format": name.upper()} | options))
        yield name, stream.getvalue()


PICTURES = dict(pictures())


@pytest.mark.parametrize("kind", PICTURES)
@QUICK
@given(what=CHANGES)
def test_images(tmp_path_factory, kind, what):
    path = tmp_path_factory.getbasetemp() / "a.png"
    path.write_bytes(changed(PICTURES[kind], what))
    image = soundly(lambda: read_image(path))
    if image is not None:
        assert (image.dtype, image.shape[2:]) == (np.uint8, (3,))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    pytest.importorskip("rosbags")
    from tests.io.streams.test_streams import write_bag

    root = tmp_path_factory.mktemp("bags")
    mcap = write_bag(root / "m", "mcap")
    sqlite = write_bag(root / "s", "sqlite")
    return {
        "ros1": write_bag(root / "a.bag", "ros1").read_bytes(),
        "mcap": next(mcap.glob("*.mcap")).read_bytes(),
        "db3": next(sqlite.glob("*.db3")).read_bytes(),
        "metadata.yaml": ((sqlite / "metadata.yaml").read_bytes(), next(sqlite.glob("*.db3"))),
    }


@pytest.mark.parametrize("kind", ["ros1", "mcap", "metadata.yaml"])
@settings(QUICK, max_examples=8)
@given(what=CHANGES)
def test_bags(tmp_path_factory, bags, kind, what):
    root = tmp_path_factory.mktemp("bag")
    content = bags[kind]
    if kind == "metadata.yaml":
        content, data = content
        (root / data.name).write_bytes(data.read_bytes())
        path = root
        (root / "metadata.yaml").write_bytes(changed(content, what))
    else:
        path = root / ("a.bag" if kind == "ros1" else "a.mcap")
        path.write_bytes(changed(content, what))
    frames = soundly(lambda: list(open_stream(path)))
    if frames is not None:
        assert all(frame.image is None or frame.image.dtype == np.uint8 for frame in frames)


# What was found, and what is large


def png_of(width, height, colour=2, bits=8):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    size = max(1, width * height * bits * {0: 1, 2: 3, 3: 1, 6: 4}[colour] // 8 + height)
    pack = zlib.compressobj(9)
    data = b"".join(pack.compress(bytes(min(1 << 20, size - at))) for at in range(0, min(size, 1 << 24), 1 << 20))
    data += pack.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


LARGE = {
    "deep JSON": (Layout.NERF, "transforms.json", b"[" * 900_000),
    "a JSON number of many digits": (Layout.NERF, "transforms.json", b'{"frames": ' + b"9" * 900_000 + b"}"),
    "long text in a matrix": (
        Layout.NERF,
        "transforms.json",
        b'{"frames": [{"file_path": "a", "transform_matrix": [["' + b"x" * 500_000 + b'"' + b",1" * 100_000 + b"]]}]}",
    ),
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
    "NULs": (Layout.KITTI, "calib.txt", bytes(990_000)),
    "a recording of many digits": (Layout.SEVENSCENES, "TrainSplit.txt", b"sequence" + b"9" * 9000 + b"\n"),
}


@contextmanager
def little_memory():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


@pytest.mark.parametrize("what", LARGE)
def test_large_and_hostile_texts(sets, what):
    layout, name, hostile = LARGE[what]
    assert len(hostile) < 1_000_000
    with little_memory():
        read_changed(sets, layout, name, lambda _: hostile)


HOSTILE_IMAGES = {
    "four million pixels": (lambda: png_of(2000, 2000, 2), False),
    "100 million pixels of 1 bit": (lambda: png_of(10_000, 10_000, 0, 1), True),
    "60000 x 60000 of 1 bit": (lambda: png_of(60_000, 60_000, 0, 1), True),
    "one row": (lambda: png_of(2_000_000_000, 1, 0, 1), True),
    "no pixel": (lambda: png_of(0, 0), True),
}


@pytest.mark.parametrize("what", HOSTILE_IMAGES)
def test_hostile_images(tmp_path, what):
    make, refused = HOSTILE_IMAGES[what]
    (tmp_path / "a.png").write_bytes(make())
    assert (tmp_path / "a.png").stat().st_size < 1_000_000
    with little_memory():
        image = soundly(lambda: read_image(tmp_path / "a.png"))
    assert (image is None) == refused
