from dataclasses import replace

import numpy as np
import pytest

from conformodal.io import THUMBNAIL, DatasetError, PixelNoise, read_recording, thumbnail
from tests.io.test_layouts import write_sevenscenes


@pytest.fixture
def image():
    y, x = np.mgrid[:120, :160]
    return np.uint8(60 + 50 * np.sin(x / 9) + 40 * np.cos(y / 7))


def test_a_thumbnail_has_no_mean_and_unit_length(image):
    picture = thumbnail(image)
    assert picture.shape == (THUMBNAIL[0] * THUMBNAIL[1],)
    assert picture.dtype == np.float32
    assert picture.mean() == pytest.approx(0, abs=1e-6)
    assert np.linalg.norm(picture) == pytest.approx(1, rel=1e-5)


def test_brightness_and_contrast_do_not_count(image):
    other = np.uint8(20 + 0.8 * image)
    assert thumbnail(image) @ thumbnail(other) > 0.999


def test_noise_has_the_size_asked_for_and_is_the_same_every_time():
    grey = np.full((240, 320, 3), 128, np.uint8)
    noise = PixelNoise(0.1, seed=3)
    noisy = noise.apply(grey, "a.png")
    assert noisy.dtype == np.uint8
    assert (noisy.astype(float) - 128).std() / 255 == pytest.approx(0.1, rel=0.01)
    np.testing.assert_array_equal(noisy, noise.apply(grey, "a.png"))
    for other in (noise.apply(grey, "b.png"), PixelNoise(0.1, seed=4).apply(grey, "a.png")):
        assert abs(np.corrcoef(noisy.ravel(), other.ravel())[0, 1]) < 0.02


def test_noise_is_cut_off_at_black_and_white_and_none_changes_nothing():
    black = np.zeros((50, 50, 3), np.uint8)
    noisy = PixelNoise(0.2).apply(black, "a")
    assert np.median(noisy) == 0
    assert noisy.max() > 100
    np.testing.assert_array_equal(PixelNoise(0.0).apply(black, "a"), black)
    for wrong, named in (
        ({"sigma": float("nan")}, "nan"),
        ({"sigma": -0.1}, "-0.1"),
        ({"sigma": 0.1, "seed": -1}, "seed"),
    ):
        with pytest.raises(DatasetError, match=named):
            PixelNoise(**wrong)


def test_a_sequence_is_read_with_its_noise(tmp_path):
    sequence = read_recording(write_sevenscenes(tmp_path))
    noise = PixelNoise(0.05)
    noisy = replace(sequence, noise=noise)
    expected = noise.apply(sequence.image(3), sequence.image_paths[3].name)
    np.testing.assert_array_equal(noisy.image(3), expected)
