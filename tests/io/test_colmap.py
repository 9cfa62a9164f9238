"""Binary COLMAP models, which pycolmap reads, against the same models as text."""

import struct
import sys

import numpy as np
import pytest

from conformodal.core.extras import MissingPackageError
from conformodal.io import DatasetError, DatasetWarning, Layout, read_recording, recognise
from tests.io.test_layouts import N, matrices, picture, write_colmap


def as_binary(folder):
    """The model of a folder, written as COLMAP writes it, in the place of the text; images have 0, 1, 2, ... points."""
    place = folder / "sparse" / "0"
    rows = [line.split() for line in (place / "cameras.txt").read_text().splitlines() if line[:1].strip("#")]
    pytest.importorskip("pycolmap")
    names = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]  # by number
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
    return as_binary(write_colmap(tmp_path))


def test_a_binary_model_is_the_text_model(tmp_path, binary):
    text, read = read_recording(write_colmap(tmp_path / "text")), read_recording(binary)
    assert recognise(binary) == Layout.COLMAP
    assert [path.name for path in read.image_paths] == [path.name for path in text.image_paths]
    np.testing.assert_allclose(read.truth.poses_se3, text.truth.poses_se3, atol=1e-12)
    assert read.camera == text.camera


def cut(file):
    return lambda content: {**content, file: content[file][:-1]}


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
    "fewer images counted": (counted("images", 4), r"images\.bin: has \d+ bytes"),
    "too many images counted": (counted("images", 2**63), "cannot be read"),
    "no image": (lambda content: {**content, "images": bytes(8)}, r"images\.bin: holds no image"),
    "an image twice": (named_twice, r"images\.bin: holds .* one twice"),
    "a lens that is not read": (of_model(10), "camera 3: camera model THIN_PRISM_FISHEYE .* is none of"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_model_is_refused(binary, what):
    change, message = DAMAGES[what]
    place = binary / "sparse" / "0"
    content = {name: (place / f"{name}.bin").read_bytes() for name in ("cameras", "images")}
    for name, changed in change(content).items():
        (place / f"{name}.bin").write_bytes(changed)
    with pytest.raises(DatasetError, match=message):
        read_recording(binary)


def test_without_pycolmap_a_binary_model_names_the_extra(binary, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingPackageError, match=r"images\.bin.*pip install 'conformodal\[colmap\]'"):
        read_recording(binary)


def test_colmap_images_without_pose_are_kept(tmp_path):
    """Folders of images are recordings."""
    write_colmap(tmp_path)
    lists = tmp_path / "sparse" / "0" / "images.txt"
    for i in range(N):
        name = f"{'left' if i < 3 else 'right'}/000{i}.png"
        (tmp_path / "images" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "images" / f"000{i}.png").rename(tmp_path / "images" / name)
        lists.write_text(lists.read_text().replace(f" 3 000{i}.png", f" 3 {name}"))
    picture(tmp_path / "images" / "left" / "0001b.png", 7)
    with pytest.warns(DatasetWarning, match=r"1 x no pose: 0001b\.png: .*images\.txt: .* does not name"):
        whole = read_recording(tmp_path, require_poses=False)
    assert [path.name for path in whole.image_paths][:3] == ["0000.png", "0001.png", "0001b.png"]
    assert whole.recording.tolist() == [0, 0, 0, 0, 1, 1]
    assert whole.posed.tolist() == [0, 1, 3, 4, 5]
    np.testing.assert_allclose(whole.poses.poses_se3, matrices(), atol=1e-9)


def test_of_several_models_the_larger_is_read_and_both_are_named(tmp_path):
    first = write_colmap(tmp_path) / "sparse" / "0"
    first.rename(tmp_path / "sparse" / "1")
    first.mkdir()
    (first / "cameras.txt").write_text("3 PINHOLE 64 48 40 40 32 24\n")
    (first / "images.txt").write_text("1 1 0 0 0 0 0 0 3 0000.png\n\n")
    with pytest.warns(DatasetWarning, match=r"sparse/1 \(5 images\) is read, not .*sparse/0 \(1 images\)"):
        recording = read_recording(tmp_path)
    np.testing.assert_allclose(recording.require_truth().poses_se3, matrices(), atol=1e-9)
    np.testing.assert_allclose(
        read_recording(tmp_path / "sparse" / "1").require_truth().poses_se3, matrices(), atol=1e-9
    )
