"""A recording whose corners are followed from frame to frame, in a run and in calibration."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from conformodal.features.local import extract_local_features, local_feature_parts
from conformodal.features.networks import make_detector
from conformodal.geometry import PinholeCamera
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.sources.landmark_map import LandmarkMap
from conformodal.localizer.turning import TurnTracker
from conformodal.pipeline import estimator as estimating
from conformodal.pipeline.calibrate import HeldOutStreams, beliefs_of_streams
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.tracking.motions import run_front_end
from tests.small_model import CAMERA, small_model

N_FRAMES, STEP_M, DEPTH_M, FOCAL_PX = 14, 0.02, 3.0, 150.0
TIMES_S = np.arange(N_FRAMES) / 30


def picture(k):
    """What a camera sees of a wall that moves along it, one pixel per frame."""
    rough = np.random.default_rng(4).uniform(0, 255, (30, 60, 3)).astype(np.float32)
    smooth = cv2.resize(rough, (240, 120), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    return np.ascontiguousarray(np.roll(smooth, -int(k), axis=1)[:, : CAMERA.width].astype(np.uint8))


@pytest.fixture(scope="module")
def model():
    """A model that knows the wall from one place."""
    detector = make_detector("xfeat", CAMERA)
    model = small_model(detector)
    local, camera = (
        extract_local_features(picture(0), CAMERA, detector),
        PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120),
    )
    points = DEPTH_M * np.column_stack((camera.on_plane(local.pixels), np.ones(len(local.pixels))))
    mapped = LandmarkMap(
        camera=camera,
        T_pose_cam=np.eye(4),
        shutter=np.zeros(2),
        origin_xyz=np.zeros(3),
        poses_se3=np.eye(4)[None],
        global_descriptors=local.global_descriptor[None].astype(np.float16),
        starts=np.array([0, len(points)]),
        points_xyz=points.astype(np.float32),
        descriptors=local.descriptors,
        corrections=np.zeros((1, 6)),
        depth_m=DEPTH_M,
    )
    sources = [*model.localizer.sources[:2], replace(model.landmarks, map=mapped, grid=None)]
    model.localizer = Localizer((*sources,), model.bins, model.sign_reference, DEPTH_M)
    return model


@pytest.fixture
def answers(model, monkeypatch):
    """The estimates of the recording's frames, and the times of those whose features were detected."""
    detected = []

    def extract(grey, *options):
        detected.append(len(estimates))
        return local_feature_parts(grey, *options)

    monkeypatch.setattr(estimating, "local_feature_parts", extract)
    odometry, estimates = VisualOdometry(model), []
    for k, time_s in enumerate(TIMES_S.tolist()):
        estimates.append(odometry.step(picture(k), time_s))
    return estimates, detected


def test_every_fifth_frame_is_detected_and_all_are_localised(answers):
    estimates, detected = answers
    assert detected == [0, 5, 10]
    for k, estimate in enumerate(estimates):
        [one] = estimate.estimates
        np.testing.assert_allclose(one.position_xyz, (STEP_M * k, 0, 0), atol=0.02)


FRAMES = np.arange(N_FRAMES)


@pytest.fixture
def held_out(model):
    """Training data of the recording, the motions between its frames, and what local features show."""
    sequence = SimpleNamespace(
        camera=CAMERA, image=picture, timestamps_s=TIMES_S, recording=np.zeros(N_FRAMES, np.int64)
    )
    looks = run_front_end(sequence, FRAMES, model.detector, motions=True)
    features = np.concatenate([model.backbone.features_of(picture(k)) for k in FRAMES])
    data = SimpleNamespace(
        sequence=sequence,
        features=features,
        detector=model.detector,
        local_features=lambda chosen: [looks.features[i] for i in chosen.tolist()],
    )
    return data, looks


def test_calibration_answers_a_held_out_stretch_as_a_run_does(model, answers, held_out):
    (data, looks), frames, features = held_out, FRAMES, held_out[0].features
    beliefs = beliefs_of_streams(
        np.zeros(N_FRAMES, np.int64), looks.motions, HeldOutStreams(data, frames, model.localizer, carries=True)
    )
    for k, estimate in enumerate(answers[0]):
        mine, its = beliefs.mixtures[k], estimate.candidates
        np.testing.assert_allclose(mine.positions_xyz, its.positions_xyz, atol=1e-6)
        np.testing.assert_allclose(mine.position_spreads, its.position_spreads, rtol=1e-5)
        np.testing.assert_allclose(mine.log_weights, its.log_weights, atol=1e-5)
    # one by one, as single frames would be calibrated, the beliefs are others
    alone = model.localizer.beliefs(FrameEvidence(features, [looks.features[i] for i in frames.tolist()]))
    assert any(
        not np.allclose(one.positions_xyz[0], other.positions_xyz[0], atol=1e-6)
        for one, other in zip(alone.mixtures, beliefs.mixtures, strict=True)
    )


def test_single_frames_are_localised_at_the_detection_rate(model, held_out, monkeypatch):
    (data, looks), asked, turned = held_out, [], []
    lost = SimpleNamespace(rows=set())
    localizer, answer = model.localizer, Localizer.beliefs

    def beliefs(self, evidence):
        its = answer(self, evidence)
        k = int(np.flatnonzero((data.features == evidence.features).all(axis=1))[0])
        asked.append(k)
        return replace(its, estimates=[[]]) if k in lost.rows else its

    monkeypatch.setattr(Localizer, "beliefs", beliefs)
    monkeypatch.setattr(TurnTracker, "advance", lambda self, motion: turned.append(motion))
    labels = np.zeros(N_FRAMES, np.int64)
    alone = beliefs_of_streams(labels, looks.motions, HeldOutStreams(data, FRAMES, localizer, carries=False))
    assert asked == [0, 5, 10]
    assert [alone.mixtures[k] is alone.mixtures[5] for k in (4, 5, 9, 10)] == [False, True, True, False]
    assert turned == [looks.motions[k] for k in FRAMES]  # the camera's roll is followed through all of them
    asked.clear()
    lost.rows = {0, 6}  # a run goes on detecting until a place is recognised
    beliefs_of_streams(labels, looks.motions, HeldOutStreams(data, FRAMES, localizer, carries=False))
    assert asked == [0, 1, 6, 7, 12]
