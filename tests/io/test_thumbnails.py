import numpy as np
import pytest

from conformodal.io import THUMBNAIL, thumbnail


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
