import numpy as np
import pytest

from conformodal.datasets import THUMBNAIL, thumbnail


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


def test_grey_images_are_as_good_as_colours_of_the_same(image):
    colour = np.repeat(image[:, :, None], 3, axis=2)
    np.testing.assert_allclose(thumbnail(colour), thumbnail(image), atol=1e-4)


def test_noise_of_single_pixels_hardly_shows(image):
    noisy = np.clip(image + np.random.default_rng(0).normal(0, 25, image.shape), 0, 255).astype(np.uint8)
    assert thumbnail(image) @ thumbnail(noisy) > 0.98


def test_rows_are_rows_of_the_image(image):
    image[:60] = 0
    image[60:] = 200
    rows = thumbnail(image).reshape(THUMBNAIL[::-1])
    assert (rows[:10] < 0).all()
    assert (rows[14:] > 0).all()


def test_an_image_without_contrast_is_zero():
    np.testing.assert_array_equal(thumbnail(np.full((48, 64, 3), 90, np.uint8)), 0)
