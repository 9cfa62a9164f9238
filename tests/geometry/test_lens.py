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
