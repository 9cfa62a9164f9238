"""An image as another camera would have seen it."""

import numpy as np

from conformodal.geometry import PinholeCamera
from conformodal.geometry.lens import filled_share, view_as

BENT = PinholeCamera(60, 62, 81, 58, 160, 120, (-0.1, 0.01, 0.0, 0.0))
Y, X = np.mgrid[:120, :160]
RAMP = np.dstack((X, 2 * Y, 0 * X)).astype(np.uint8)


def test_a_pixel_shows_what_lies_on_its_ray():
    target, at = PinholeCamera(80, 80, 50, 40, 100, 80), np.array([[20, 10], [70, 60], [50, 40]])
    rays = (at - (50, 40)) / 80
    square = (rays**2).sum(axis=1, keepdims=True)
    seen = rays * (1 - 0.1 * square + 0.01 * square**2) * (60, 62) + (81, 58)
    np.testing.assert_allclose(view_as(RAMP, BENT, target)[at[:, 1], at[:, 0], :2], seen * (1, 2), atol=1.5)
    assert filled_share(BENT, target) == 1


def test_a_wider_and_coarser_camera_sees_black_around_the_image():
    target = PinholeCamera(20, 20, 50, 40, 100, 80)
    brought = view_as(RAMP, BENT, target)
    np.testing.assert_allclose(brought[40, 50, :2], (81, 116), atol=3)
    assert not brought[0].any()
    assert 0.1 < filled_share(BENT, target) < 0.4


def test_what_a_finer_lens_does_not_see_is_black():
    """Though the image is made coarser first."""
    white = np.full((960, 1280), 255, np.uint8)
    source = PinholeCamera(1200, 1200, 639.5, 479.5, 1280, 960, (-0.3, 0.0, 0.0, 0.0))
    brought = view_as(white, source, PinholeCamera(200, 200, 159.5, 119.5, 320, 240))
    assert np.isin(brought, (0, 255)).mean() > 0.97
    assert not brought[[0, 0, -1, -1], [0, -1, 0, -1]].any()
