"""Images of every kind become the right pixels or are refused, and every frame keeps its own pose."""

import io
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from conformodal.datasets import DatasetError, DatasetWarning, ImageError, Layout, read_image, read_sequence
from conformodal.datasets.decoding import decode, image_fault, image_size, natural_key

sys.path.insert(0, str(Path(__file__).parents[1] / "datasets"))
from test_layouts import PLACES, SIZE, WRITERS, N, matrices, picture

RAMP = (np.arange(64 * 48, dtype=np.int64).reshape(48, 64) * 65535 // (64 * 48 - 1)).astype(np.uint16)
GREY = ((RAMP.astype(np.int64) * 255 + 32767) // 65535).astype(np.uint8)
COLOURS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def saved(image, suffix, **options):
    stream = io.BytesIO()
    kind = {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF", ".bmp": "BMP", ".pgm": "PPM", ".webp": "WEBP"}[suffix]
    image.save(stream, kind, **options)
    return stream.getvalue()


def with_alpha(alpha):
    return Image.fromarray(np.dstack((COLOURS, np.broadcast_to(np.asarray(alpha, np.uint8), (48, 64)))))


def palette():
    return Image.fromarray(GREY).quantize(256)


HALF = np.where(np.arange(64) < 32, 255, 0)
ON_BLACK = np.where((np.arange(64) < 32)[None, :, None], COLOURS, 0)
THREE = np.repeat(GREY[..., None], 3, axis=2)

RIGHT = {
    "8-bit grey png": (lambda: saved(Image.fromarray(GREY), ".png"), THREE, 0),
    "16-bit grey png": (lambda: saved(Image.fromarray(RAMP), ".png"), THREE, 0),
    "16-bit grey tiff": (lambda: saved(Image.fromarray(RAMP), ".tif"), THREE, 0),
    "16-bit big-endian tiff": (lambda: saved(Image.fromarray(RAMP.astype(">u2")), ".tif"), THREE, 0),
    "16-bit pgm": (lambda: b"P5\n64 48\n65535\n" + RAMP.astype(">u2").tobytes(), THREE, 1),
    "rgb png": (lambda: saved(Image.fromarray(COLOURS), ".png"), COLOURS, 0),
    "rgb bmp": (lambda: saved(Image.fromarray(COLOURS), ".bmp"), COLOURS, 0),
    "rgb tiff": (lambda: saved(Image.fromarray(COLOURS), ".tif"), COLOURS, 0),
    "rgb webp": (lambda: saved(Image.fromarray(COLOURS), ".webp", lossless=True), COLOURS, 0),
    "opaque rgba png": (lambda: saved(with_alpha(255), ".png"), COLOURS, 0),
    "half transparent rgba png": (lambda: saved(with_alpha(HALF), ".png"), ON_BLACK, 0),
    "opaque grey with alpha": (lambda: saved(Image.fromarray(GREY).convert("LA"), ".png"), THREE, 0),
    "transparent rgb png": (lambda: saved(Image.new("RGB", SIZE, (9, 8, 7)), ".png", transparency=(9, 8, 7)), 0, 0),
    "palette png": (lambda: saved(palette(), ".png"), THREE, 2),
    "palette png with one transparent": (
        lambda: saved(Image.new("P", SIZE, 3), ".png", transparency=3),
        0,
        0,
    ),
    "1-bit png": (lambda: saved(Image.fromarray(GREY > 127), ".png"), np.where(THREE > 127, 255, 0), 0),
    "1-bit tiff": (lambda: saved(Image.fromarray(GREY > 127), ".tif"), np.where(THREE > 127, 255, 0), 0),
    "cmyk jpeg": (lambda: saved(Image.new("RGB", SIZE, (200, 100, 50)).convert("CMYK"), ".jpg"), (200, 100, 50), 4),
    "grey jpeg": (lambda: saved(Image.new("L", SIZE, 77), ".jpg"), 77, 1),
}


@pytest.mark.parametrize("what", RIGHT)
def test_images_of_a_kind_become_the_right_pixels(tmp_path, what):
    make, expected, tolerance = RIGHT[what]
    (tmp_path / "a.png").write_bytes(make())  # what counts is the content
    image = read_image(tmp_path / "a.png", SIZE)
    assert image.dtype == np.uint8
    assert image.shape == (48, 64, 3)
    np.testing.assert_allclose(image.astype(int), np.broadcast_to(expected, image.shape), atol=tolerance)
    assert image_fault(tmp_path / "a.png", SIZE) == ""
    np.testing.assert_array_equal(decode(make(), "bytes"), image)


def turned(orientation, suffix):
    exif = Image.Exif()
    exif[0x0112] = orientation
    return saved(Image.fromarray(COLOURS), suffix, exif=exif.tobytes())


def animated(suffix):
    return saved(Image.new("RGB", SIZE), suffix, save_all=True, append_images=[Image.new("RGB", SIZE, (9, 9, 9))])


def bomb(width, height, bits=8):
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    data = zlib.compress(bytes(100_000), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


WHOLE = saved(Image.fromarray(COLOURS), ".png")
JPEG = saved(Image.fromarray(COLOURS), ".jpg")

WRONG = {
    "nothing": (b"", "cannot be decoded"),
    "zeros": (bytes(5000), "cannot be decoded"),
    "text": (b"404: Not Found", "cannot be decoded"),
    "html": (b"<!DOCTYPE html><html>", "cannot be decoded"),
    "png header alone": (WHOLE[:33], "cannot be decoded"),
    "half a png": (WHOLE[: len(WHOLE) // 2], "cannot be decoded"),
    "png without its last byte of pixels": (WHOLE[:-40], "cannot be decoded"),
    "half a jpeg": (JPEG[: len(JPEG) // 2], "cannot be decoded"),
    "jpeg header alone": (JPEG[:20], "cannot be decoded"),
    "other size": (saved(Image.new("RGB", (48, 64)), ".png"), "48x64 pixels, the camera's are 64x48"),
    "one pixel": (saved(Image.new("RGB", (1, 1)), ".png"), "1x1 pixels"),
    "float tiff": (saved(Image.fromarray(GREY / np.float32(255)), ".tif"), "floating point"),
    "32-bit tiff": (saved(Image.fromarray(RAMP.astype(np.int32)), ".tif"), "32-bit"),
    "turned jpeg": (turned(6, ".jpg"), "EXIF orientation is 6"),
    "jpeg upside down": (turned(3, ".jpg"), "EXIF orientation is 3"),
    "mirrored png": (turned(2, ".png"), "EXIF orientation is 2"),
    "turned tiff": (saved(Image.fromarray(COLOURS), ".tif", tiffinfo={0x0112: 8}), "EXIF orientation is 8"),
    "animated png": (animated(".png"), "holds 2 pictures"),
    "tiff of two pages": (animated(".tif"), "holds 2 pictures"),
    "animated webp": (animated(".webp"), "holds 2 pictures"),
    "60000 x 60000": (bomb(60000, 60000), "claims 60000x60000|exceeds limit"),
    "10000 x 10000 in a hundred bytes": (bomb(10000, 10000), "claims 10000x10000"),
    "1-bit 20000 x 20000": (bomb(20000, 20000, 1), "claims 20000x20000|exceeds limit"),
    "postscript": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\nshowpage\n", "cannot be decoded"),
}


@pytest.mark.parametrize("what", WRONG)
def test_images_that_are_none_are_refused_by_name(tmp_path, what):
    content, match = WRONG[what]
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=rf"a\.png: .*({match})"):
        read_image(path, SIZE)
    assert "a.png" in image_fault(path, SIZE)


@pytest.mark.parametrize("what", WRONG)
@pytest.mark.parametrize("place", [0, 3])
def test_such_an_image_costs_its_frame(tmp_path, what, place):
    folder = WRITERS[Layout.TUM](tmp_path)
    (folder / "rgb" / f"{place}.png").write_bytes(WRONG[what][0])
    with pytest.warns(DatasetWarning, match=rf"1 x left out, image cannot be read.*{place}\.png"):
        sequence = read_sequence(folder)
    kept = [i for i in range(N) if i != place]
    np.testing.assert_allclose(sequence.require_truth().positions_xyz, PLACES[kept], atol=1e-9)
    np.testing.assert_allclose(sequence.timestamps_s, 100 + 0.1 * np.array(kept))
    assert [sequence.image(k)[0, 0, 0] for k in range(N - 1)] == [10 * i for i in kept]


def test_an_exif_that_is_damaged_says_nothing(tmp_path):
    (tmp_path / "a.jpg").write_bytes(saved(Image.fromarray(COLOURS), ".jpg", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff"))
    assert read_image(tmp_path / "a.jpg").shape == (48, 64, 3)


@pytest.mark.parametrize(
    "names",
    [
        ("frame2.png", "frame10.png"),
        ("2.png", "10.png"),
        ("a2b10.png", "a10b2.png"),
        ("f-009.jpg", "f-0010.jpg"),
        ("s1/f9.png", "s1/f10.png", "s2/f1.png", "s10/f1.png"),
        ("f9999999999999999999.png", "f10000000000000000000.png"),
        ("f1.png", "f01.png") if natural_key("f1.png") < natural_key("f01.png") else ("f01.png", "f1.png"),
    ],
)
def test_names_are_in_the_order_of_their_numbers(names):
    backwards = list(names)[::-1]
    assert sorted(backwards, key=natural_key) == list(names)


ELEVEN = 11


def long_scene(layout, root):
    """Eleven frames whose names have no leading zeros, x = their number."""
    poses = np.tile(np.eye(4), (ELEVEN, 1, 1))
    poses[:, 0, 3] = np.arange(ELEVEN)
    text = "".join(" ".join(map(str, pose[:3].ravel())) + "\n" for pose in poses)
    camera = "40 0 32\n0 40 24\n0 0 1\n"
    if layout is Layout.IMAGES:
        for i in range(ELEVEN):
            picture(root / f"frame{i}.png", i)
        (root / "camera-intrinsics.txt").write_text(camera)
        (root / "poses.txt").write_text(text)
    elif layout is Layout.KITTI:
        root = root / "sequences" / "03"
        for i in range(ELEVEN):
            picture(root / "image_2" / f"{i}.png", i)
        (root / "calib.txt").write_text("P2: 40 0 32 0 0 40 24 0 0 0 1 0\n")
        (root / "poses.txt").write_text(text)
    elif layout is Layout.NERF:
        import json

        frames = []
        for i, pose in enumerate(poses):
            picture(root / f"frame{i}.png", i)
            frames.append({"file_path": f"frame{i}.png", "transform_matrix": pose.tolist()})
        content = {"fl_x": 40, "fl_y": 40, "cx": 32, "cy": 24, "frames": frames[::-1]}
        (root / "transforms.json").write_text(json.dumps(content))
    elif layout is Layout.COLMAP:
        lines = []
        for i in range(ELEVEN):
            picture(root / f"frame{i}.png", i)
            lines += [f"{i + 1} 1 0 0 0 {-i} 0 0 1 frame{i}.png", ""]
        (root / "images.txt").write_text("\n".join([*lines[::-1][1:], ""]))
        (root / "cameras.txt").write_text("1 PINHOLE 64 48 40 40 32 24\n")
    elif layout is Layout.SEVENSCENES:
        for i in range(ELEVEN):
            picture(root / f"frame-{i}.color.png", i)
            np.savetxt(root / f"frame-{i}.pose.txt", poses[i])
        (root / "camera-intrinsics.txt").write_text(camera)
    else:
        root = root / "imgs" / "scene_1"
        for i in range(ELEVEN):
            picture(root / f"{i}-color.png", i)
        (root.parent.parent / "pc").mkdir()
        rows = "".join(f"1 0 0 0 {i} 0 0\n" for i in range(ELEVEN))
        (root.parent.parent / "pc" / "1.pose").write_text(rows)
        (root / "camera-intrinsics.txt").write_text(camera)
    return root


BY_NAME = (Layout.IMAGES, Layout.KITTI, Layout.NERF, Layout.COLMAP, Layout.SEVENSCENES, Layout.RGBD_SCENES)


@pytest.mark.parametrize("layout", BY_NAME)
@pytest.mark.parametrize("suffix", [".png", ".PNG"])
def test_frame_10_comes_after_frame_2_and_keeps_its_pose(tmp_path, layout, suffix):
    folder = long_scene(layout, tmp_path)
    if suffix != ".png":
        if layout in (Layout.NERF, Layout.COLMAP):
            path = folder / ("transforms.json" if layout is Layout.NERF else "images.txt")
            path.write_text(path.read_text().replace(".png", suffix))
        for path in list(tmp_path.rglob("*.png")):
            path.rename(path.with_suffix(suffix))
    sequence = read_sequence(folder)
    assert len(sequence) == ELEVEN
    np.testing.assert_allclose(sequence.require_truth().positions_xyz[:, 0], np.arange(ELEVEN))
    assert [int(sequence.image(i)[0, 0, 0]) for i in range(ELEVEN)] == [10 * i for i in range(ELEVEN)]


def test_recordings_and_scenes_are_in_the_order_of_their_numbers(tmp_path):
    for number in (1, 2, 10):
        picture(tmp_path / f"seq-{number}" / "frame-000000.color.png", number)
        np.savetxt(tmp_path / f"seq-{number}" / "frame-000000.pose.txt", np.eye(4))
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    assert [p.parent.name for p in read_sequence(tmp_path).image_paths] == ["seq-1", "seq-2", "seq-10"]


def test_names_that_are_times_are_in_the_order_of_time(tmp_path):
    for i, name in enumerate(("9.5", "10.25", "10.5", "100.0")):
        picture(tmp_path / f"{name}.png", i)
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    sequence = read_sequence(tmp_path, require_poses=False)
    assert sequence.timestamps_s.tolist() == [9.5, 10.25, 10.5, 100.0]
    assert [int(sequence.image(i)[0, 0, 0]) for i in range(4)] == [0, 10, 20, 30]


def without_points(text):
    return "\n".join(line for line in text.splitlines() if line.startswith("#") or line.endswith(".png")) + "\n"


def empty_points(text):
    return "\n".join(x if x.startswith("#") or x.endswith(".png") else "" for x in text.splitlines()) + "\n"


def spaced(text):
    return empty_points(text).rstrip("\n")


def many_points(text):
    return text.replace("10.5 11.5 -1", "10 11 -1 " * 40 + "10 11 -1")


@pytest.mark.parametrize(
    "change", [without_points, empty_points, spaced, many_points, lambda t: t.replace("\n", "\r\n")]
)
def test_colmap_images_with_and_without_points_are_all_read(tmp_path, change):
    WRITERS[Layout.COLMAP](tmp_path)
    path = next(tmp_path.rglob("images.txt"))
    path.write_bytes(change(path.read_text()).encode())
    sequence = read_sequence(tmp_path)
    np.testing.assert_allclose(sequence.require_truth().poses_se3, matrices(), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: t.replace("10.5 11.5 -1 12.0 13.0 44\n", "", 1), "has no line of points"),
        (lambda t: t.replace("10.5 11.5 -1 12.0 13.0 44\n", "10.5 11.5\n", 1), "expected 'id qw"),
        (lambda t: t.replace(" 0003.png", ""), "expected 'id qw"),
        (lambda t: without_points(t).replace(" 0003.png", ""), "has no line of points"),
        (lambda t: without_points(t).replace(" 3 0003.png", ""), "expected 'id qw"),
        (lambda t: t.replace("0003.png", "0002.png"), "a second time"),
        (lambda t: t.replace("44\n", "44\n1 2 3 4 5 6 7 8 9 10 11 12\n", 1), "expected 'id qw"),
        (lambda t: t.replace(" 3 0003", " 3_0 0003"), "expected 'id qw"),
    ],
)
def test_colmap_images_that_cannot_be_told_apart_from_points_are_refused(tmp_path, change, match):
    WRITERS[Layout.COLMAP](tmp_path)
    path = next(tmp_path.rglob("images.txt"))
    path.write_text(change(path.read_text()))
    with pytest.raises(DatasetError, match=rf"images\.txt.*{match}"):
        read_sequence(tmp_path)


STRANGERS = {
    "old-frame-000003.color.png": 0,
    "frame-000003.color.png.bak": 0,
    "frame-000003.color.png~": 0,
    "frame-000003.color (1).png": 0,
    "._frame-000003.color.png": 0,
    "xframe-000003.color.png": 0,
    "frame-000003.colour.png": 0,
    "frame--00003.color.png": 0,
    "frame-\u0663.color.png": 0,
    "frame-000003.depth.png": 0,
    "frame-000003.color.jpg": 1,
    "frame-000003.color.JPEG": 1,
    "frame-3.color.png": 1,
    "frame-0000003.color.png": 1,
    "frame-99999999999999999999.color.png": 0,
}


@pytest.mark.parametrize("name", STRANGERS)
def test_files_that_look_like_a_7_scenes_frame_do_not_replace_it(tmp_path, name):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    content = saved(Image.new("RGB", SIZE, (255, 255, 255)), ".png")
    (tmp_path / "seq-01" / name).write_bytes(content)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequence = read_sequence(folder)
    assert len([w for w in caught if issubclass(w.category, DatasetWarning)]) == STRANGERS[name]
    assert len(sequence) == N
    assert [int(sequence.image(i)[0, 0, 0]) for i in range(N)] == [10 * i for i in range(N)]
    assert all(name in where for _, where in sequence.notes)


@pytest.mark.parametrize("name", ["00003-color.PNG", "3-color.png", "000003-color.png", "x00003-color.png"])
def test_files_that_look_like_an_rgbd_scenes_frame_do_not_replace_it(tmp_path, name):
    folder = WRITERS[Layout.RGBD_SCENES](tmp_path)
    (folder / name).write_bytes(saved(Image.new("RGB", SIZE, (255, 255, 255)), ".png"))
    sequence = read_sequence(folder)
    assert len(sequence) == N
    if name != "00003-color.PNG":  # which of the two it is, nobody knows; one of them is told
        assert [int(sequence.image(i)[0, 0, 0]) for i in range(N)] == [10 * i for i in range(N)]
    assert len(sequence.notes) == (0 if name.startswith("x") else 1)


@pytest.mark.parametrize("name", ["seq-01-old", "seq-01 (copy)", "seq-bad", "seq-01.bak"])
def test_folders_that_look_like_a_recording_are_told(tmp_path, name):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    picture(tmp_path / name / "frame-000000.color.png", 25)
    with pytest.warns(DatasetWarning, match="no recording"):
        assert len(read_sequence(folder)) == N


def test_two_folders_of_one_recording_are_refused(tmp_path):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    picture(tmp_path / "seq-1" / "frame-000000.color.png", 25)
    with pytest.raises(DatasetError, match=r"seq-0?1: another folder has its number"):
        read_sequence(folder)


@pytest.mark.parametrize(("layout", "name"), [(Layout.IMAGES, "frame3.jpg"), (Layout.KITTI, "3.JPG")])
def test_one_name_with_two_suffixes_is_one_frame(tmp_path, layout, name):
    folder = long_scene(layout, tmp_path)
    place = folder / "image_2" if layout is Layout.KITTI else folder
    (place / name).write_bytes(JPEG)
    with pytest.warns(DatasetWarning, match="another file has its name"):
        sequence = read_sequence(folder)
    assert [int(sequence.image(i)[0, 0, 0]) for i in range(ELEVEN)] == [10 * i for i in range(ELEVEN)]


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("odd", [0, 2])
def test_an_image_of_another_size_costs_its_frame(tmp_path, layout, odd):
    folder = WRITERS[layout](tmp_path)
    before = read_sequence(folder)
    Image.new("RGB", (128, 96)).save(before.image_paths[odd])
    with pytest.warns(DatasetWarning, match="128x96 pixels, the camera's are 64x48"):
        sequence = read_sequence(folder)
    kept = [i for i in range(N) if i != odd]
    assert sequence.image_paths == tuple(before.image_paths[i] for i in kept)
    np.testing.assert_allclose(sequence.timestamps_s, before.timestamps_s[kept])
    np.testing.assert_allclose(sequence.require_truth().poses_se3, before.truth.poses_se3[kept])
    whole = read_sequence(folder, require_poses=False)
    with pytest.raises(ImageError, match="128x96"):
        whole.image(odd)


@pytest.mark.parametrize(
    ("layout", "count"), [(Layout.IMAGES, ELEVEN - 1), (Layout.IMAGES, ELEVEN + 1), (Layout.KITTI, ELEVEN - 1)]
)
def test_poses_paired_by_order_must_be_as_many_as_images(tmp_path, layout, count):
    folder = long_scene(layout, tmp_path)
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * count)
    with pytest.raises(DatasetError, match=rf"poses\.txt: holds {count} poses, but there are {ELEVEN} images"):
        read_sequence(folder)


@pytest.mark.parametrize("layout", [Layout.IMAGES, Layout.KITTI, Layout.RGBD_SCENES])
def test_a_blank_line_among_poses_paired_by_line_is_refused(tmp_path, layout):
    folder = long_scene(layout, tmp_path)
    path = tmp_path / "imgs" / ".." / "pc" / "1.pose" if layout is Layout.RGBD_SCENES else folder / "poses.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:4], "", *lines[4:]]) + "\n")
    with pytest.raises(DatasetError, match="line 5: is blank"):
        read_sequence(folder)


def test_a_kitti_image_that_is_missing_moves_no_pose(tmp_path):
    folder = long_scene(Layout.KITTI, tmp_path)
    (folder / "image_2" / "3.png").unlink()
    sequence = read_sequence(folder)
    kept = [i for i in range(ELEVEN) if i != 3]
    np.testing.assert_allclose(sequence.require_truth().positions_xyz[:, 0], kept)
    np.testing.assert_allclose(sequence.timestamps_s, np.array(kept) / 10)
    assert image_size(sequence.image_paths[0]) == SIZE


def test_a_kitti_image_that_is_missing_moves_no_time(tmp_path):
    folder = long_scene(Layout.KITTI, tmp_path)
    (folder / "times.txt").write_text("\n".join(str(0.5 * i) for i in range(ELEVEN)))
    (folder / "image_2" / "3.png").unlink()
    assert read_sequence(folder).timestamps_s[3] == 2.0
