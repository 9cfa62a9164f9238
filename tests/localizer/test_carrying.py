"""Corners that are followed from frame to frame, in images of a textured wall that moves sideways."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from conformodal.features.local import LocalFeatures, QualityRange, image_quality
from conformodal.geometry.camera import NO_FLOW
from conformodal.localizer import carrying
from conformodal.localizer.carrying import CarrySettings, FeatureStream, StreamFrame
from conformodal.localizer.evidence import LandmarkView, PoseMeasurement
from tests.localizer.conftest import CAMERA

STEP_PX, STEP_S = 1.5, 1 / 30  # between frames


def wall(k, seed=0):
    """Frame k, which shows the wall further to the right."""
    rough = np.random.default_rng(seed).uniform(0, 255, (60, 120)).astype(np.float32)
    smooth = cv2.resize(rough, (960, 480), interpolation=cv2.INTER_CUBIC)
    shift = np.array([[1, 0, -STEP_PX * k], [0, 1, 0]])
    return cv2.warpAffine(smooth, shift, (CAMERA.width, CAMERA.height)).clip(0, 255).astype(np.uint8)


class Wall:
    """A source that knows where landmarks are: a grid on the wall; the pose is the shift in pixels."""

    grid = np.stack(np.meshgrid(np.arange(60, 300, 20.0), np.arange(20, CAMERA.height - 20, 20.0)), axis=-1)
    landmarks = grid.reshape(-1, 2)

    def __init__(self):
        self.n_matched, self.recognised, self.followed = 0, True, []

    def localize(self, image):
        self.n_matched += 1
        if not self.recognised:
            return []
        every = np.arange(len(image.pixels))
        return [self.estimate(image.pixels, LandmarkView(every, every, np.eye(4)), 0.99)]

    def carry(self, image, view, detected, n_followed):
        self.followed.append((image.pixels[view.corners], self.landmarks[view.landmarks], n_followed))
        return self.estimate(image.pixels, view, 0.99)

    def estimate(self, pixels, view, probability):
        shift = float((self.landmarks[view.landmarks] - pixels[view.corners])[:, 0].mean())
        quat = np.array([1.0, 0, 0, 0])
        return PoseMeasurement(np.array([shift, 0, 0]), quat, 0.1, 0.1, len(view.corners), probability, view=view)


class Camera:
    """Frames of the wall, and the images in which corners were detected."""

    def __init__(self, source, n_parts=1, **options):
        localizer = SimpleNamespace(carrying_source=source)
        detector = SimpleNamespace(rotation_invariant=True, n_parts=n_parts)
        self.stream = FeatureStream(localizer, CAMERA, detector, **options)
        self.n_parts, self.detected, self.parts = n_parts, [], []

    def look(self, k, grey=None, time_s=None):
        def detect(turn_rad):
            self.detected.append(k)
            for part in range(self.n_parts - 1):
                self.parts.append((k, part))
                yield None
            self.parts.append((k, self.n_parts - 1))
            pixels = Wall.landmarks - (STEP_PX * k, 0)
            yield LocalFeatures(pixels, np.zeros((len(pixels), 64), np.int8), np.zeros(0, np.float32))

        self.parts.append(k)
        grey, time_s = wall(k) if grey is None else grey, k * STEP_S if time_s is None else time_s
        look = self.stream.look(StreamFrame(grey, time_s, None, NO_FLOW), detect)
        self.stream.observe(look.estimates or [])
        return look


def test_corners_are_tracked_between_detections():
    """Matches come one frame after their detection."""
    source = Wall()
    camera = Camera(source, settings=CarrySettings(detect_every_s=4.5 * STEP_S))
    matched = []
    for k in range(11):
        look = camera.look(k)
        matched.append(source.n_matched)
        assert look.carried == (k > 0)
        assert look.estimates[0].position_xyz[0] == pytest.approx(STEP_PX * k, abs=0.05)
        assert look.estimates[0].view is None  # it would be stored with every frame of a run
    assert camera.detected == [0, 5, 10]
    assert matched == [1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2]
    for k, (pixels, landmarks, _) in enumerate(source.followed, start=1):
        # each corner is still that of its landmark
        np.testing.assert_allclose(np.median(np.abs(landmarks - pixels - (STEP_PX * k, 0)), axis=0), 0, atol=0.1)


def test_corners_that_were_followed_beside_others_are_taken():
    camera, shifted = Camera(Wall()), Camera(Wall())
    for one in (camera, shifted):
        assert one.stream.corners_to_follow(0.0) is None
        one.look(0)
    image, pixels = camera.stream.corners_to_follow(STEP_S)
    assert camera.stream.corners_to_follow(1.0) is None  # too far away in time
    followed = carrying.follow_corners(image, wall(1), pixels)
    expected = camera.look(1).features.pixels
    frame = StreamFrame(wall(1), STEP_S, None, NO_FLOW, followed._replace(pixels=followed.pixels + 0.25))
    look = shifted.stream.look(frame, None)
    np.testing.assert_allclose(look.features.pixels, expected + 0.25, atol=1e-5)


def test_detection_work_is_spread_over_frames():
    """The frame after the last part matches."""
    source = Wall()
    camera = Camera(source, n_parts=3, settings=CarrySettings(detect_every_s=4.5 * STEP_S))
    for k in range(9):
        before = source.n_matched
        look = camera.look(k)
        assert look.estimates[0].position_xyz[0] == pytest.approx(STEP_PX * k, abs=0.05)
        assert source.n_matched - before == (k in (0, 8))
        assert look.busy == (k in (5, 6, 7, 8))
    assert camera.parts == [0, (0, 0), (0, 1), (0, 2), 1, 2, 3, 4, 5, (5, 0), 6, (5, 1), 7, (5, 2), 8]


@pytest.mark.parametrize(("step_s", "matched"), [(1 / 30, 8), (0.05, 7), (0.1, 6)])
def test_where_frames_are_further_apart_the_work_is_done_sooner(step_s, matched):
    source = Wall()
    camera = Camera(source, n_parts=3, settings=CarrySettings(detect_every_s=4.5 * step_s))
    found = []
    for k in range(9):
        camera.look(k, time_s=k * step_s)
        found += [k] * (source.n_matched == 2 and not found)
    assert found == [matched]


@pytest.mark.parametrize(("kept", "detected", "carried"), [(0.9, [0], True), (0.6, [0, 2], True), (0.3, [0, 2], False)])
def test_lost_corners_trigger_early_detection(monkeypatch, kept, detected, carried):
    camera, follow = Camera(Wall(), n_parts=3), carrying.follow_corners
    camera.look(0)
    camera.look(1)

    def lose(*images_and_pixels):
        there, alive = follow(*images_and_pixels)
        return there, alive & (np.arange(len(alive)) < kept * len(alive))

    monkeypatch.setattr(carrying, "follow_corners", lose)
    assert camera.look(2).carried == carried
    assert camera.detected == detected
    n_parts = {True: len(detected) - 1, False: 3}[carried]  # all of them at once, or one
    assert sum(isinstance(part, tuple) and part[0] == 2 for part in camera.parts) == n_parts


def test_lost_detections_fall_back_to_tracked_corners(monkeypatch):
    """Where the detected corners are lost, those of the frame before are followed."""
    source, follow = Wall(), carrying.follow_corners
    camera = Camera(source, n_parts=3, settings=CarrySettings(detect_every_s=4.5 * STEP_S))
    for k in range(8):
        camera.look(k)

    def lose(previous, image, pixels):
        there, alive = follow(previous, image, pixels)
        return there, alive & np.array_equal(previous, wall(7))

    monkeypatch.setattr(carrying, "follow_corners", lose)
    look = camera.look(8)
    assert look.carried
    assert look.estimates[0].position_xyz[0] == pytest.approx(STEP_PX * 8, abs=0.05)
    assert camera.detected == [0, 5]


def test_tracked_corners_are_limited_and_spread_out():
    source = Wall()
    camera = Camera(source, settings=CarrySettings(max_corners=40))
    camera.look(0)
    camera.look(1)
    [(pixels, _, n_followed)] = source.followed
    assert n_followed == 40 >= len(pixels) > 30
    assert np.ptp(pixels[:, 1]) > 0.8 * np.ptp(Wall.landmarks[:, 1])


@pytest.mark.parametrize("cause", ["cut", "gap", "blank", "out of range"])
def test_corners_are_detected_where_they_cannot_be_followed(cause):
    known = QualityRange.of(image_quality(wall(0)) * np.array([[0.7], [1.3]]))
    camera = Camera(Wall(), quality=known)
    camera.look(0)
    assert camera.look(1).carried
    grey = {"cut": wall(0, seed=9), "blank": np.full_like(wall(0), 128), "out of range": wall(2) // 3}.get(cause)
    assert not camera.look(2, grey, 3.0 if cause == "gap" else None).carried
    assert camera.detected == [0, 2]


def test_tracking_needs_exactly_one_recognised_place():
    source = Wall()
    camera = Camera(source)
    source.recognised = False
    assert [camera.look(k).carried for k in range(3)] == [False] * 3
    source.recognised = True
    assert [camera.look(k).carried for k in range(3, 5)] == [False, True]
    localize = source.localize
    source.localize = lambda image: 2 * localize(image)
    camera = Camera(source)
    assert [camera.look(k).carried for k in range(3)] == [False] * 3


def test_unmatched_detections_are_repeated():
    """Where the detected features recognise nothing one frame later, that frame detects again."""
    source = Wall()
    camera = Camera(source, settings=CarrySettings(detect_every_s=1.5 * STEP_S))
    assert camera.look(0).estimates
    source.recognised = False
    assert [camera.look(k).carried for k in (1, 2, 3)] == [True, True, False]
    assert camera.detected == [0, 2, 3]


@pytest.mark.parametrize(("source", "options"), [(Wall(), {"follows": False}), (None, {})])
def test_frames_are_independent_without_tracking(source, options):
    """Without a stream, or without a source that follows corners."""
    camera = Camera(source, **options)
    looks = [camera.look(k) for k in range(3)]
    assert [look.estimates for look in looks] == [None] * 3  # the localizer asks its sources
    assert camera.detected == [0, 1, 2]


def test_nothing_is_followed_into_a_new_recording():
    camera = Camera(Wall())
    camera.look(0)
    camera.stream.reset()
    assert not camera.look(1).carried
