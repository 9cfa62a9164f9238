"""Images of every kind become the right pixels or are refused, and every frame keeps its own pose."""

import io
import re
import warnings

import numpy as np
import pytest
from PIL import Image

from conformodal.io import DatasetWarning, ImageError, Layout, read_image, read_recording
from conformodal.io.decoding import decode, image_fault, image_size, natural_key
from tests.io.test_layouts import SIZE, WRITERS, N, matrices, picture

RAMP = (np.arange(64 * 48, dtype=np.int64).reshape(48, 64) * 65535 // (64 * 48 - 1)).astype(np.uint16)
GREY = ((RAMP.astype(np.int64) * 255 + 32767) // 65535).astype(np.uint8)
COLOURS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def saved(image, suffix, **options):
    stream = io.BytesIO()
    kind = {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF", ".bmp": "BMP", ".pgm": "PPM", ".webp": "WEBP"}[suffix]
    image.save(stream, kind, **options)
    return stream.getvalue()


def zero_is_white(array):
    """A TIFF of numbers that are larger where it is darker."""
    content = saved(Image.fromarray(np.iinfo(array.dtype).max - array), ".tif")
    tag, one, zero = b"\x06\x01\x03\x00\x01\x00\x00\x00", b"\x01\x00", b"\x00\x00"
    assert tag + one in content
    return content.replace(tag + one, tag + zero)


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_levels_of_a_tiff_whose_zero_is_white_are_those_of_its_bits(tmp_path, bits):
    ramp = np.tile(np.linspace(0, 2**bits - 1, 64).round().astype(np.uint16), (48, 1))
    white = 2**16 - 1 - (2**bits - 1 - ramp)  # zero_is_white takes it from 16 bits
    (tmp_path / "a.tif").write_bytes(zero_is_white(white.astype(np.uint16)))
    np.testing.assert_allclose(read_image(tmp_path / "a.tif")[0, :, 0], np.linspace(0, 255, 64), atol=1)
    bright = np.tile(np.arange(64, dtype=np.uint16), (48, 1))  # so near white that it uses few bits, unlike the others
    found = decode(zero_is_white(2**16 - 1 - bright), "a.tif", white=2**bits - 1)
    np.testing.assert_allclose(found[..., 0], 255 * (1 - bright / (2**bits - 1)), atol=1)


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
    "8-bit tiff whose zero is white": (lambda: zero_is_white(GREY), THREE, 0),
    "16-bit tiff whose zero is white": (lambda: zero_is_white(RAMP), THREE, 0),
    "16-bit pgm": (lambda: b"P5\n64 48\n65535\n" + RAMP.astype(">u2").tobytes(), THREE, 1),
    "rgb png": (lambda: saved(Image.fromarray(COLOURS), ".png"), COLOURS, 0),
    "rgb webp": (lambda: saved(Image.fromarray(COLOURS), ".webp", lossless=True), COLOURS, 0),
    "opaque rgba png": (lambda: saved(with_alpha(255), ".png"), COLOURS, 0),
    "half transparent rgba png": (lambda: saved(with_alpha(HALF), ".png"), ON_BLACK, 0),
    "transparent rgb png": (lambda: saved(Image.new("RGB", SIZE, (9, 8, 7)), ".png", transparency=(9, 8, 7)), 0, 0),
    "palette png": (lambda: saved(palette(), ".png"), THREE, 2),
    "palette png with one transparent": (lambda: saved(Image.new("P", SIZE, 3), ".png", transparency=3), 0, 0),
    "1-bit png": (lambda: saved(Image.fromarray(GREY > 127), ".png"), np.where(THREE > 127, 255, 0), 0),
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


WHOLE = saved(Image.fromarray(COLOURS), ".png")
JPEG = saved(Image.fromarray(COLOURS), ".jpg")

WRONG = {
    "nothing": (b"", "cannot be decoded"),
    "text": (b"404: Not Found", "cannot be decoded"),
    "half a png": (WHOLE[: len(WHOLE) // 2], "cannot be decoded"),
    "png without its last byte of pixels": (WHOLE[:-40], "cannot be decoded"),
    "half a jpeg": (JPEG[: len(JPEG) // 2], "cannot be decoded"),
    "other size": (saved(Image.new("RGB", (48, 64)), ".png"), "48x64 pixels, the camera's are 64x48"),
    "float tiff": (saved(Image.fromarray(GREY / np.float32(255)), ".tif"), "floating point"),
    "32-bit tiff": (saved(Image.fromarray(RAMP.astype(np.int32)), ".tif"), "32-bit"),
    "animated png": (animated(".png"), "holds 2 pictures"),
    "tiff of two pages": (animated(".tif"), "holds 2 pictures"),
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


# orientation: what makes the stored pixels upright
UPRIGHT = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(a, 2).transpose(1, 0, 2),
    8: np.rot90,
}


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_images_are_turned_as_their_exif_says_and_it_is_told(tmp_path, orientation, suffix):
    content = (
        saved(Image.fromarray(COLOURS), ".tif", tiffinfo={0x0112: orientation})
        if suffix == ".tif"
        else turned(orientation, suffix)
    )
    (tmp_path / f"0{suffix}").write_bytes(content)
    expected = UPRIGHT[orientation](decode(saved(Image.fromarray(COLOURS), suffix), "stored"))
    height, width = expected.shape[:2]
    image = read_image(tmp_path / f"0{suffix}", (width, height))
    np.testing.assert_array_equal(image, expected)
    assert image_fault(tmp_path / f"0{suffix}", (width, height)) == ""
    (tmp_path / "camera-intrinsics.txt").write_text(f"40 0 {width / 2}\n0 40 {height / 2}\n0 0 1\n")
    with pytest.warns(DatasetWarning, match="as its EXIF orientation says"):
        sequence = read_recording(tmp_path, require_poses=False)
    assert sequence.image(0).shape == expected.shape


@pytest.mark.parametrize(("bits", "told"), [(10, True), (12, True), (14, True), (16, False)])
def test_images_of_16_bits_are_scaled_by_the_bits_that_the_data_set_uses(tmp_path, bits, told):
    """One factor for all of them: the dark image is dark."""
    for i, most in enumerate((2**bits - 1, 2 ** (bits - 3))):
        (tmp_path / f"{i}.png").write_bytes(saved(Image.fromarray((RAMP * (most / 65535)).astype(np.uint16)), ".png"))
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    with warnings.catch_warnings(record=True) as came:
        warnings.simplefilter("always")
        sequence = read_recording(tmp_path, require_poses=False)
    assert any("is shown as white" in str(one.message) for one in came) is told
    for i, share in enumerate((1, 1 / 8)):
        np.testing.assert_allclose(sequence.image(i)[..., 0], RAMP * (255 / 65535 * share), atol=1.1)


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


BY_NAME = (Layout.IMAGES, Layout.KITTI, Layout.NERF, Layout.COLMAP, Layout.SEVENSCENES, Layout.RGBD_SCENES)


def values(sequence):
    """The red of every frame, which is ten times its number."""
    return [int(sequence.image(i)[0, 0, 0]) for i in range(len(sequence))]


@pytest.mark.parametrize("layout", BY_NAME)
def test_suffixes_may_be_in_capitals(tmp_path, layout):
    folder = WRITERS[layout](tmp_path)
    for path in [*tmp_path.rglob("images.txt"), *tmp_path.rglob("transforms.json")]:
        path.write_text(re.sub(r"(\d{4})(\.png|(?=\"))", r"\1.PNG", path.read_text()))
    for path in list(tmp_path.rglob("*.png")):
        path.rename(path.with_suffix(".PNG"))
    sequence = read_recording(folder)
    np.testing.assert_allclose(sequence.require_truth().poses_se3, matrices(), atol=1e-9)
    assert values(sequence) == [10 * i for i in range(N)]


def test_recordings_and_scenes_are_in_the_order_of_their_numbers(tmp_path):
    for number in (1, 2, 10):
        picture(tmp_path / f"seq-{number}" / "frame-000000.color.png", number)
        np.savetxt(tmp_path / f"seq-{number}" / "frame-000000.pose.txt", np.eye(4))
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1\n")
    assert [p.parent.name for p in read_recording(tmp_path).image_paths] == ["seq-1", "seq-2", "seq-10"]


def other_points(make):
    """Lines of points replaced, by one line or by none."""

    def change(text):
        images = [[x] if x.startswith("#") or x.endswith(".png") else make(x) for x in text.splitlines()]
        return "\n".join(line for lines in images for line in lines)

    return change


without_points = other_points(lambda line: [])
POINTS = {
    "no lines": without_points,
    "empty lines": other_points(lambda line: [""]),
    "many": other_points(lambda line: ["10 11 -1 " * 40 + "10 11 -1"]),
    "CRLF": lambda text: text.replace("\n", "\r\n"),
}


@pytest.mark.parametrize("what", POINTS)
def test_colmap_images_with_and_without_points_are_all_read(tmp_path, what):
    WRITERS[Layout.COLMAP](tmp_path)
    path = next(tmp_path.rglob("images.txt"))
    for end in ("", "\n"):
        path.write_bytes((POINTS[what](path.read_text()).rstrip("\n") + end).encode())
        np.testing.assert_allclose(read_recording(tmp_path).require_truth().poses_se3, matrices(), atol=1e-9)


STRANGERS = {
    "old-frame-000003.color.png": 0,
    "frame-000003.color.png~": 0,
    "frame-000003.color (1).png": 0,
    "._frame-000003.color.png": 0,
    "frame-000003.colour.png": 0,
    "frame--00003.color.png": 0,
    "frame-\u0663.color.png": 0,
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
        sequence = read_recording(folder)
    assert len([w for w in caught if issubclass(w.category, DatasetWarning)]) == STRANGERS[name]
    assert len(sequence) == N
    assert values(sequence) == [10 * i for i in range(N)]
    assert all(name in where for _, where in sequence.notes)


@pytest.mark.parametrize("name", ["seq-01-old", "seq-01 (copy)", "seq-bad", "seq-01.bak"])
def test_folders_that_look_like_a_recording_are_told(tmp_path, name):
    folder = WRITERS[Layout.SEVENSCENES](tmp_path)
    picture(tmp_path / name / "frame-000000.color.png", 25)
    with pytest.warns(DatasetWarning, match="no recording"):
        assert len(read_recording(folder)) == N


def test_one_name_with_two_suffixes_is_one_frame(tmp_path):
    folder = WRITERS[Layout.KITTI](tmp_path)
    (folder / "image_0" / "000003.JPG").write_bytes(JPEG)
    with pytest.warns(DatasetWarning, match="another file has its name"):
        sequence = read_recording(folder)
    assert values(sequence) == [10 * i for i in range(N)]


@pytest.mark.parametrize("times", [0.1, 0.5])
def test_a_kitti_image_that_is_missing_moves_no_pose_and_no_time(tmp_path, times):
    folder = WRITERS[Layout.KITTI](tmp_path)
    (folder / "times.txt").write_text("\n".join(str(times * i) for i in range(N)))
    (folder / "image_0" / "000002.png").unlink()
    sequence = read_recording(folder)
    kept = np.array([0, 1, 3, 4])
    np.testing.assert_allclose(sequence.require_truth().poses_se3, matrices()[kept], atol=1e-9)
    np.testing.assert_allclose(sequence.timestamps_s, times * kept)
    assert image_size(sequence.image_paths[0]) == SIZE
