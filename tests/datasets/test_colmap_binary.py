import struct
from dataclasses import asdict

import numpy as np
import pytest

from conformodal.datasets import DatasetError, Layout, read_colmap, recognise
from conformodal.datasets.colmap_binary import _MODELS

from .test_layouts import write_colmap


def as_binary(folder):
    """The model of a folder, written as COLMAP writes it, in the place of the text; images have 0, 1, 2, ... points."""
    place = folder / "sparse" / "0"
    rows = [line.split() for line in (place / "cameras.txt").read_text().splitlines() if line[:1].strip("#")]
    names = [name for name, _ in _MODELS]
    cameras = struct.pack("<Q", len(rows))
    for camera, model, width, height, *values in rows:
        cameras += struct.pack("<iiQQ", int(camera), names.index(model), int(width), int(height))
        cameras += struct.pack(f"<{len(values)}d", *map(float, values))
    rows = [line.split() for line in (place / "images.txt").read_text().splitlines() if line.endswith(".png")]
    images = struct.pack("<Q", len(rows))
    for k, (number, *pose, camera, name) in enumerate(rows):
        images += struct.pack("<i7di", int(number), *map(float, pose), int(camera)) + name.encode() + b"\0"
        images += struct.pack("<Q", k) + struct.pack("<ddq", 1.5, 2.5, -1) * k
    for name, content in (("cameras", cameras), ("images", images)):
        (place / f"{name}.txt").unlink()
        (place / f"{name}.bin").write_bytes(content)
    return folder


@pytest.fixture
def binary(tmp_path):
    write_colmap(tmp_path)
    return as_binary(tmp_path)


def test_a_binary_model_is_the_text_model(tmp_path, binary):
    write_colmap(tmp_path / "text")
    text, found = read_colmap(tmp_path / "text"), read_colmap(binary)
    assert recognise(binary) is Layout.COLMAP
    assert [path.name for path in found.image_paths] == [path.name for path in text.image_paths]
    np.testing.assert_array_equal(found.truth.poses_se3, text.truth.poses_se3)
    assert asdict(found.camera) == asdict(text.camera)


@pytest.mark.parametrize("name", ["cameras", "images"])
def test_damaged_files_are_named(binary, name):
    path = binary / "sparse" / "0" / f"{name}.bin"
    whole = path.read_bytes()
    for cut in (*range(0, min(len(whole), 200), 7), len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(DatasetError, match=rf"{name}\.bin: is no binary model"):
            read_colmap(binary)
    path.write_bytes(whole + b"more")
    with pytest.raises(DatasetError, match=r"4 bytes follow"):
        read_colmap(binary)
    path.write_bytes(struct.pack("<Q", 2**63))
    with pytest.raises(DatasetError, match="is no binary model"):
        read_colmap(binary)
    path.write_bytes(struct.pack("<Q", 0))
    with pytest.raises(DatasetError, match="holds no"):
        read_colmap(binary)


def test_other_cameras_are_refused_as_those_of_text_are(binary):
    path = binary / "sparse" / "0" / "cameras.bin"
    head, values = struct.unpack("<QiiQQ", path.read_bytes()[:32]), path.read_bytes()[32:]
    path.write_bytes(struct.pack("<QiiQQ", *head[:2], 10, *head[3:]) + values + bytes(32))
    with pytest.raises(DatasetError, match=r"record 1: camera model THIN_PRISM_FISHEYE is none of"):
        read_colmap(binary)
    path.write_bytes(struct.pack("<QiiQQ", *head[:2], 99, *head[3:]) + values)
    with pytest.raises(DatasetError, match="has the model 99"):
        read_colmap(binary)


def test_an_image_is_named_once(binary):
    path = binary / "sparse" / "0" / "images.bin"
    content = path.read_bytes()
    first = content[8 : content.index(b"\0", 8 + 64) + 1 + 8]
    path.write_bytes(struct.pack("<Q", 2) + first + first)
    with pytest.raises(DatasetError, match="a second time"):
        read_colmap(binary)
