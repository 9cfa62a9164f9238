from io import BytesIO
from zipfile import ZIP_DEFLATED, ZipFile

import cv2
import numpy as np
import pytest
from sklearn.datasets import load_sample_image

from conformodal.features.local import HALFWAY_CELL, HALFWAY_CHANNELS, XFeatDetector, extract_local_features, match
from conformodal.features.networks import make_detector
from conformodal.features.settings import VisionError
from conformodal.geometry import PinholeCamera


def texture(width, height, seed=0):
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, (width, height), interpolation=cv2.INTER_NEAREST))


def camera(width, height, lens=()):
    return PinholeCamera(width, width, width / 2, height / 2, width, height, lens)


@pytest.fixture(scope="module", params=["orb", "xfeat"])
def detector(request):
    return make_detector(request.param, camera(600, 400))


def test_corners_of_a_shifted_image_are_shifted(detector):
    image = load_sample_image("china.jpg")
    here = extract_local_features(image[:400, :600], camera(600, 400), detector)
    there = extract_local_features(image[7:407, 12:612], camera(600, 400), detector)
    (pairs,) = match(here.descriptors, [there.descriptors])
    assert len(pairs) > 100
    off = here.pixels[pairs[:, 0]] - there.pixels[pairs[:, 1]] - (12, 7)
    most = {"orb": 2, "xfeat": 8}[detector.name]  # XFeat describes cells of eight pixels
    assert np.mean(np.linalg.norm(off, axis=1) < most) > 0.9
    np.testing.assert_allclose(np.median(off, axis=0), 0, atol=0.2)


@pytest.mark.parametrize("degrees", [-90, 60])
def test_turning_back_a_rolled_image_recovers_corners(detector, degrees):
    image = load_sample_image("china.jpg")[:400, :600]
    roll = cv2.getRotationMatrix2D((299.5, 199.5), -degrees, 1.0)
    rolled = np.asarray(cv2.warpAffine(image, roll, (600, 400)))
    upright = extract_local_features(image, camera(600, 400), detector)

    def matched(turn_rad):
        """Matches of the upright image whose corners are where the roll has moved them."""
        here = extract_local_features(rolled, camera(600, 400), detector, turn_rad)
        (pairs,) = match(here.descriptors, [upright.descriptors])
        moved = upright.pixels[pairs[:, 1]] @ roll[:, :2].T + roll[:, 2]
        return np.linalg.norm(here.pixels[pairs[:, 0]] - moved, axis=1) < 4

    back = matched(np.radians(-degrees))
    assert back.sum() > 50
    assert back.mean() > 0.8
    # ORB turns its patches itself
    assert detector.rotation_invariant == (matched(0.0).sum() > 0.5 * back.sum())


def test_enlarging_small_images_does_not_shift_corners():
    large = texture(320, 240)
    small = np.asarray(cv2.resize(large, (160, 120), interpolation=cv2.INTER_AREA))
    one, other = extract_local_features(large, camera(320, 240)), extract_local_features(small, camera(160, 120))
    (pairs,) = match(one.descriptors, [other.descriptors])
    a, b = one.pixels[pairs[:, 0]], other.pixels[pairs[:, 1]]
    off = b - ((a + 0.5) / 2 - 0.5)  # the centre of the first pixel is 0 in both
    assert len(off) > 20
    np.testing.assert_allclose(np.median(off, axis=0), 0, atol=0.15)


def test_the_lens_is_taken_out():
    image = texture(640, 480)
    straight = extract_local_features(image, camera(640, 480))
    bent = extract_local_features(image, camera(640, 480, (-0.2, 0.05, 0.0, 0.0)))
    far = np.linalg.norm(straight.pixels - (320, 240), axis=1) > 150
    away = np.linalg.norm(bent.pixels - straight.pixels, axis=1)
    assert (away[far] > 1).all()
    np.testing.assert_array_equal(bent.descriptors, straight.descriptors)


def test_a_blank_image_has_no_corners(detector):
    blank = extract_local_features(np.full((400, 600, 3), 90, np.uint8), camera(600, 400), detector)
    assert blank.pixels.shape == (0, 2)
    assert blank.descriptors.shape == detector.nothing.descriptors.shape
    assert blank.descriptors.dtype == detector.nothing.descriptors.dtype
    np.testing.assert_allclose(np.linalg.norm(blank.global_descriptor), detector.describes_images, atol=1e-6)
    assert [len(pairs) for pairs in match(blank.descriptors, [blank.descriptors] * 2)] == [0, 0]
    assert detector.name == "orb" or detector.maps(np.zeros((320, 448), np.uint8))[1].shape == (40, 56)  # reduced


def test_matches_are_those_of_the_definition():
    """Nearest by differing bits, clearly nearer than the second, and the best of those that share it."""
    rng = np.random.default_rng(1)
    others = rng.integers(0, 256, (70, 32), dtype=np.uint8)
    noise = (rng.random((120, 32)) < rng.choice([0.05, 0.3, 0.6], (120, 1))).astype(np.uint8)
    some = others[rng.integers(0, 70, 120)] ^ noise * rng.integers(1, 256, (120, 32), dtype=np.uint8)
    bits = [np.unpackbits(its, axis=1).astype(int) for its in (some, others)]
    distances = np.abs(bits[0][:, None] - bits[1]).sum(axis=2)
    first, second = np.sort(distances, axis=1)[:, :2].T
    found = {}
    for i in np.lexsort((np.arange(120), first)):
        if first[i] < 0.85 * second[i]:
            found.setdefault(int(distances[i].argmin()), int(i))
    assert 20 < len(found) < 70
    alone, beside = match(some, [others])[0], match(some, [some[:30], others])[1]
    assert {int(j): int(i) for i, j in alone} == found
    np.testing.assert_array_equal(beside, alone)


def test_matches_are_mutual_and_similar_enough():
    rng = np.random.default_rng(2)
    others = rng.standard_normal((50, 64))
    some = others[rng.integers(0, 50, 90)] + rng.uniform(0, 1.5, (90, 1)) * rng.standard_normal((90, 64))
    some, others = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (some, others))
    cosine = some @ others.T
    mutual = (cosine == cosine.max(axis=1, keepdims=True)) & (cosine == cosine.max(axis=0)) & (cosine >= 0.75)
    as_bytes = [np.clip(np.rint(254 * rows), -127, 127).astype(np.int8) for rows in (some, others)]
    expected = set(zip(*np.nonzero(mutual), strict=True))
    assert 10 < len(expected) < 50
    assert len(expected ^ set(map(tuple, match(as_bytes[0], as_bytes[1:])[0].tolist()))) <= 2  # rounding to bytes


def test_xfeat_comes_as_its_package_has_it():
    import torch

    from scripts.networks import XFeat

    xfeat, image, network = make_detector("xfeat", camera(96, 64)), texture(96, 64), XFeat()
    whole = torch.from_numpy(image)
    halfway, *_ = network(whole, torch.zeros((HALFWAY_CHANNELS, 64 // HALFWAY_CELL, 96 // HALFWAY_CELL)))
    _, *theirs = network(whole, halfway)
    for mine, its in zip(xfeat.maps(image), theirs, strict=True):
        np.testing.assert_allclose(mine, its.numpy(), atol=1e-4 * its.abs().max())


def test_work_in_parts_gives_the_same_corners():
    xfeat, image = make_detector("xfeat", camera(96, 64)), texture(96, 64)
    *before, corners = xfeat.parts(image)
    assert before == [None] * (xfeat.n_parts - 1)
    for part, whole in zip(corners, xfeat(image), strict=True):
        np.testing.assert_array_equal(part, whole)


@pytest.mark.parametrize("content", [b"", b"no archive", "other", "compressed"])
def test_what_is_not_the_network_of_xfeat_in_parts_is_refused(content):
    if isinstance(content, str):
        archive, name = BytesIO(), "else.onnx" if content == "other" else "halfway.onnx"
        with ZipFile(archive, "w", ZIP_DEFLATED) as file:
            file.writestr(name, bytes(100_000 if content == "compressed" else 10))
        content = archive.getvalue()
    with pytest.raises(VisionError, match="network of local features"):
        XFeatDetector(content)
