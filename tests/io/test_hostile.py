"""Hostile files: a typed error or a valid object comes out, in bounded time and memory, and nothing is executed."""

import struct
import time
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from conformodal.conformal import ConformodalError
from conformodal.io import Layout, read_image, read_recording
from tests.io.test_layouts import WRITERS, N

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning", "error::RuntimeWarning")


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
    """Fails if the process needs 200 MB more for a while; the peak of earlier tests is forgotten."""
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_kib()
    yield
    assert peak_kib() - before < 200_000


def peak_kib():
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return int(line.split()[1])


@pytest.mark.parametrize("what", LARGE)
def test_large_and_hostile_texts(tmp_path, what):
    layout, name, hostile = LARGE[what]
    folder = WRITERS[layout](tmp_path)
    next(tmp_path.rglob(name)).write_bytes(hostile)
    with little_memory():
        recording = soundly(lambda: read_recording(folder, layout))
    if recording is not None:
        assert 1 <= len(recording) <= N
        assert np.isfinite(recording.require_truth().poses_se3).all()


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
