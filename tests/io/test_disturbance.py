from dataclasses import replace

import numpy as np
import pytest

from conformodal.io import DatasetError, Disturbance, PixelNoise, read_recording
from tests.io.test_layouts import write_sevenscenes

IMAGE = np.random.default_rng(0).integers(60, 190, (48, 64, 3), dtype=np.uint8)
SMOOTH = np.tile(np.linspace(60, 190, 64).astype(np.uint8)[None, :, None], (48, 1, 3))


def test_disturbance_depends_on_seed_and_name_only():
    own = [Disturbance(seed).apply(IMAGE, name) for seed, name in ((1, "a"), (1, "a"), (2, "a"), (1, "b"))]
    np.testing.assert_array_equal(own[0], own[1])
    assert all((own[0] != other).any() for other in own[2:])
    assert all(its.shape == IMAGE.shape and its.dtype == np.uint8 for its in own)


def test_each_kind_comes_in_a_fifth_of_the_images():
    """On a smooth image: darker, brighter, noisy ones are told by their pixels; blur and JPEG nearly leave it."""
    kinds = {"darker": 0, "brighter": 0, "noise": 0, "little": 0}
    for i in range(200):
        off = Disturbance(0).apply(SMOOTH, str(i)).astype(float) - SMOOTH
        if off.mean() < -20:
            kinds["darker"] += 1
        elif off.mean() > 20:
            kinds["brighter"] += 1
        else:
            kinds["noise" if off.std() > 6 else "little"] += 1
    # binomial, n = 200: bounds that are left with a probability below 1e-4
    assert all(20 <= kinds[kind] <= 63 for kind in ("darker", "brighter", "noise")), kinds
    assert 52 <= kinds["little"] <= 108, kinds


def test_noise_that_images_have_anyway_comes_first():
    noise = PixelNoise(0.1)
    expected = Disturbance(3).apply(noise.apply(IMAGE, "a"), "a")
    np.testing.assert_array_equal(Disturbance(3, noise).apply(IMAGE, "a"), expected)


def test_noise_has_the_size_asked_for_and_is_the_same_every_time():
    grey = np.full((240, 320, 3), 128, np.uint8)
    noise = PixelNoise(0.1, seed=3)
    noisy = noise.apply(grey, "a.png")
    assert noisy.dtype == np.uint8
    assert (noisy.astype(float) - 128).std() / 255 == pytest.approx(0.1, rel=0.01)
    np.testing.assert_array_equal(noisy, noise.apply(grey, "a.png"))
    for other in (noise.apply(grey, "b.png"), PixelNoise(0.1, seed=4).apply(grey, "a.png")):
        assert abs(np.corrcoef(noisy.ravel(), other.ravel())[0, 1]) < 0.02


def test_noise_is_clipped_and_zero_noise_is_identity():
    black = np.zeros((50, 50, 3), np.uint8)
    noisy = PixelNoise(0.2).apply(black, "a")
    assert np.median(noisy) == 0
    assert noisy.max() > 100
    np.testing.assert_array_equal(PixelNoise(0.0).apply(black, "a"), black)
    for sigma in (float("nan"), -0.1):
        with pytest.raises(DatasetError, match="noise needs"):
            PixelNoise(sigma)


def test_a_sequence_is_read_with_its_noise(tmp_path):
    sequence = read_recording(write_sevenscenes(tmp_path))
    noise = PixelNoise(0.05)
    noisy = replace(sequence, noise=noise)
    expected = noise.apply(sequence.image(3), sequence.image_paths[3].name)
    np.testing.assert_array_equal(noisy.image(3), expected)
