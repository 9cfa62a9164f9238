"""Keyframes are sharp and differ in view; a camera that stands still adds none."""

import cv2
import numpy as np
import pytest

from conformodal.mapping.keyframes import KeyframePicker, reduced, sharpness

RNG = np.random.default_rng(0)
WIDE = cv2.GaussianBlur(RNG.integers(0, 255, (240, 1200), dtype=np.uint8), (0, 0), 2)
WIDE = cv2.normalize(WIDE, None, 0, 255, cv2.NORM_MINMAX)


def views(steps):
    """Views of a wide picture, so many pixels farther to the right each."""
    return [np.repeat(WIDE[:, x : x + 320, None], 3, axis=2) for x in np.cumsum(steps)]


def picked(images, flow_px=20):
    picker = KeyframePicker(flow_px)
    for k, image in enumerate(images):
        picker.add(k, image)
    return picker.finish()


def test_a_camera_that_stands_still_adds_no_keyframe():
    assert picked(views([0] * 10)) == [0]


@pytest.mark.parametrize("step", [2, 5, 10])
def test_keyframes_follow_the_motion_and_not_the_rate(step):
    steps = np.diff(picked(views([0] + [step] * (200 // step)))) * step
    assert steps.min() >= 10
    assert steps.max() <= 20


def test_of_frames_that_would_do_the_sharpest_is_taken():
    images = views([0] + [4] * 5)
    for k in (2, 3, 5):
        images[k] = cv2.GaussianBlur(images[k], (0, 0), 1.5)
    assert picked(images)[1] == 4


def test_a_fast_turn_takes_every_frame():
    assert picked(views([0, 150, 150, 150, 150])) == [0, 1, 2, 3, 4]


def test_dark_frames_are_no_keyframes():
    images = views([0] + [15] * 6)
    images[2:5] = [np.zeros_like(image) for image in images[2:5]]
    assert not {2, 3, 4} & set(picked(images))


def test_blur_is_less_sharp_and_large_images_are_reduced():
    grey = WIDE[:, :640]
    assert sharpness(cv2.GaussianBlur(grey, (0, 0), 2)) < 0.5 * sharpness(grey)
    assert reduced(np.zeros((1080, 1920, 3), np.uint8)).shape == (360, 640)
    assert reduced(grey).shape == grey.shape
