"""Images of every kind become the right pixels or are refused."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from conformodal.io import DatasetError, DatasetWarning, ImageError, read_image, read_recording
from conformodal.io.decoding import decode, image_fault
from tests.io.test_layouts import SIZE

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
    "16-bit pgm": (lambda: b"P5\n64 48\n65535\n" + RAMP.astype(">u2").tobytes(), THREE, 1),
    "rgb png": (lambda: saved(Image.fromarray(COLOURS), ".png"), COLOURS, 0),
    "opaque rgba png": (lambda: saved(with_alpha(255), ".png"), COLOURS, 0),
    "half transparent rgba png": (lambda: saved(with_alpha(HALF), ".png"), ON_BLACK, 0),
    "transparent rgb png": (lambda: saved(Image.new("RGB", SIZE, (9, 8, 7)), ".png", transparency=(9, 8, 7)), 0, 0),
    "palette png": (lambda: saved(palette(), ".png"), THREE, 2),
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
    "half a png": (WHOLE[: len(WHOLE) // 2], "cannot be decoded"),
    "png without its last byte of pixels": (WHOLE[:-40], "cannot be decoded"),
    "half a jpeg": (JPEG[: len(JPEG) // 2], "cannot be decoded"),
    "other size": (saved(Image.new("RGB", (48, 64)), ".png"), "48x64 pixels, the camera's are 64x48"),
    "float tiff": (saved(Image.fromarray(GREY / np.float32(255)), ".tif"), "mode F"),
    "animated png": (animated(".png"), "holds 2 pictures"),
    "16-bit tiff whose zero is white": (zero_is_white(RAMP), "without a white level"),
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
def test_exif_orientation_is_applied_and_reported(tmp_path, orientation, suffix):
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
    if suffix == ".tif":  # which Pillow turns itself
        assert read_recording(tmp_path, require_poses=False).camera.height == height
        return
    with pytest.warns(DatasetWarning, match="as its EXIF orientation says"):
        sequence = read_recording(tmp_path, require_poses=False)
    assert sequence.image(0).shape == expected.shape


@pytest.mark.parametrize("suffix", ["png", "tiff", "ppm"])
@pytest.mark.parametrize("white", [1023, 65535])
def test_16_bit_images_are_scaled_or_refused(tmp_path, suffix, white):
    """Those that use few of the 16 bits are refused."""
    rgb = np.empty((6, 8, 3), np.uint16)
    rgb[...] = np.array([1.0, 0.5, 0.25]) * white
    for name, image in (("a", rgb[..., ::-1]), ("b", rgb[..., 0]))[: 1 if suffix == "ppm" else 2]:
        folder = tmp_path / name
        folder.mkdir()
        (folder / "camera-intrinsics.txt").write_text("10 0 4\n0 10 3\n0 0 1\n")
        cv2.imwrite(str(folder / f"a.{suffix}"), image)
        if white < 65535:
            with pytest.raises(DatasetError, match=rf"a\.{suffix}: has 16 bits, and images use less"):
                read_recording(folder, require_poses=False)
        else:
            expected = [255, 127.5, 63.75] if name == "a" else 255
            np.testing.assert_allclose(read_recording(folder, require_poses=False).image(0)[0, 0], expected, atol=1)
