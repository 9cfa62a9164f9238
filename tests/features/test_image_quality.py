import cv2
import numpy as np
import pytest

from conformodal.features.local import NOT_MEASURED, QUALITIES, QualityRange, image_quality


@pytest.fixture(scope="module")
def grey():
    rough = np.random.default_rng(0).uniform(60, 180, (60, 80)).astype(np.float32)
    return cv2.resize(rough, (320, 240), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def test_detail_of_pure_noise_is_known():
    """The response to the mask is normal, with the root of its squared weights, six, times the noise's deviation."""
    noisy = np.random.default_rng(1).normal(128, 10, (400, 400)).round().astype(np.uint8)
    assert image_quality(noisy)[2] == pytest.approx(6 * 10 * np.sqrt(2 / np.pi), rel=0.02)
    ramp = np.tile(np.arange(200, dtype=np.uint8), (200, 1))
    assert image_quality(ramp)[2] < 0.1


@pytest.mark.parametrize(
    ("change", "moved", "sign"),
    [
        (lambda grey: grey // 4, "brightness", -1),
        (lambda grey: np.minimum(grey + 60.0, 255).astype(np.uint8), "brightness", 1),
        (lambda grey: cv2.GaussianBlur(grey, (0, 0), 4.0), "detail", -1),
        (lambda grey: (grey // 2 + 64).astype(np.uint8), "contrast", -1),
    ],
)
def test_a_disturbance_moves_its_quality_out_of_range(grey, change, moved, sign):
    own = image_quality(grey)
    known = QualityRange.of(own * np.array([[0.95], [1.05]]))
    found = image_quality(change(grey))
    assert not known.is_outside(own[None])[0]
    assert known.is_outside(found[None])[0]
    at = QUALITIES.index(moved)
    assert sign * (found[at] - own[at]) > 0.05 * own[at]


def test_range_includes_its_ends_and_unmeasured_values():
    known = QualityRange.of(np.array([[1.0, 2, 3], [4, 5, 6]]))
    beyond = np.array([4.0, 5, 6.4])
    assert known.is_outside(np.array([known.low, known.high, NOT_MEASURED, beyond])).tolist() == [False] * 3 + [True]
