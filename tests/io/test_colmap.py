"""Binary COLMAP models, which pycolmap reads, against the same models as text."""

import struct
import sys

import numpy as np
import pytest

from conformodal.core.extras import MissingPackageError
from conformodal.io import DatasetError, Layout, read_colmap, recognise
from tests.io.test_layouts import as_binary, write_colmap


@pytest.fixture
def binary(tmp_path):
    return as_binary(write_colmap(tmp_path))


def test_a_binary_model_is_the_text_model(tmp_path, binary):
    text, read = read_colmap(write_colmap(tmp_path / "text")), read_colmap(binary)
    assert recognise(binary) is Layout.COLMAP
    assert [path.name for path in read.image_paths] == [path.name for path in text.image_paths]
    np.testing.assert_allclose(read.truth.poses_se3, text.truth.poses_se3, atol=1e-12)
    assert read.camera == text.camera


def cut(file):
    return lambda content: {**content, file: content[file][:-1]}


def appended(file):
    return lambda content: {**content, file: content[file] + b"more"}


def counted(file, n):
    return lambda content: {**content, file: struct.pack("<Q", n) + content[file][8:]}


def of_model(number):
    return lambda content: {
        **content, "cameras": content["cameras"][:12] + struct.pack("<i", number) + content["cameras"][16:] + bytes(32)
    }  # fmt: skip


def named_twice(content):
    first = content["images"][8 : content["images"].index(b"\0", 72) + 9]
    return {**content, "images": struct.pack("<Q", 2) + first + struct.pack("<i", 99) + first[4:]}


DAMAGES = {
    "images cut": (cut("images"), r"images\.bin: has \d+ bytes"),
    "cameras cut": (cut("cameras"), r"cameras\.bin: has \d+ bytes"),
    "bytes after the images": (appended("images"), r"images\.bin: has \d+ bytes"),
    "bytes after the cameras": (appended("cameras"), r"cameras\.bin: has \d+ bytes"),
    "fewer images counted": (counted("images", 4), r"images\.bin: has \d+ bytes"),
    "too many images counted": (counted("images", 2**63), "cannot be read"),
    "no image": (lambda content: {**content, "images": bytes(8)}, r"images\.bin: holds no image"),
    "an image twice": (named_twice, r"images\.bin: names '0004\.png' a second time"),
    "a lens that is not read": (of_model(10), "camera 3: camera model THIN_PRISM_FISHEYE is none of"),
    "no model": (of_model(99), "cannot be read"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_model_is_refused(binary, what):
    change, message = DAMAGES[what]
    place = binary / "sparse" / "0"
    content = {name: (place / f"{name}.bin").read_bytes() for name in ("cameras", "images")}
    for name, changed in change(content).items():
        (place / f"{name}.bin").write_bytes(changed)
    with pytest.raises(DatasetError, match=message):
        read_colmap(binary)


def test_without_pycolmap_a_binary_model_names_the_extra(binary, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingPackageError, match=r"images\.bin.*pip install 'conformodal\[colmap\]'"):
        read_colmap(binary)
