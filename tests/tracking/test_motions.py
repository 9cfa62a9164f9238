import cv2
import numpy as np
import pytest

from conformodal.features.local import ORB
from conformodal.geometry import MotionStatus, PinholeCamera
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import ImageError
from conformodal.tracking.motions import frame_features, run_front_end
from conformodal.tracking.tracker import MotionFrontEnd, affine_flow

W, H = 320, 240
HZ = 30


class Pan:
    """A camera that moves along a wall at a constant speed; some frames cannot be read."""

    camera = PinholeCamera(W, W, W / 2, H / 2, W, H)

    def __init__(self, n, px, unreadable=()):
        rng, size = np.random.default_rng(0), (W + n * px, H)
        scales = [rng.normal(128, 40, (H // cell, size[0] // cell)) for cell in (12, 48)]
        self.wall = np.mean([cv2.resize(one, size, interpolation=cv2.INTER_CUBIC) for one in scales], axis=0)
        self.px, self.unreadable = px, unreadable
        self.timestamps_s, self.recording = np.arange(n) / HZ, np.zeros(n, int)

    def image(self, i):
        if i in self.unreadable:
            raise ImageError(f"frame {i}: unreadable")
        return self.wall[:, i * self.px :][:, :W].clip(0, 255).astype(np.uint8)


def middle(flow):
    return flow @ (W / 2, H / 2, 1)


def flows_of_a_run(pan, every):
    """In the answered frames, as a stream measures them."""
    front_end, flows, before = MotionFrontEnd(pan.camera), {}, 0
    for i in [i for i in range(len(pan.recording)) if i not in pan.unreadable]:
        if i % every:
            front_end.track_only(pan.image(i))
        else:
            front_end.measure(pan.image(i))
            flows[i] = affine_flow(front_end.tracker.step, (i - before) / HZ, pan.camera)
        before = i
    return flows


@pytest.mark.parametrize("every", [1, 4, 10])
def test_runs_have_the_flow_that_training_has(every):
    pan = Pan(21, px=8, unreadable=(7, *range(11, 20)))
    for i, flow in flows_of_a_run(pan, every).items():
        expected = [-8 * HZ if 0 < i < 20 else 0, 0]  # the last frame that can be read before 20 is 0.33 s ago
        after_a_gap = i - 1 in pan.unreadable  # training does without the flow there
        for one in (flow, frame_features(pan, i, ORB).flow):
            assert middle(one) == pytest.approx([0, 0] if after_a_gap and one is not flow else expected, abs=4), i


def test_one_pass_gives_all_features_and_motions(monkeypatch):
    """Though it is cut into segments."""
    pan, frames = Pan(21, px=8), np.array([2, 3, 5, 6, 9, 12, 13, 20])
    whole = run_front_end(pan, frames, ORB, motions=True)
    monkeypatch.setattr("conformodal.tracking.motions._SEGMENT", 3)
    cut = run_front_end(pan, frames, ORB, motions=True)
    for looks in (whole, cut):
        assert set(frames) == looks.features.keys() <= looks.motions.keys()
        for i in frames.tolist():
            assert middle(looks.features[i].flow) == pytest.approx([-8 * HZ, 0], abs=4), i
    for i in frames[1:].tolist():
        assert whole.motions[i].status == cut.motions[i].status != MotionStatus.TOO_FEW, i


LENS = PinholeCamera(500, 500, 320, 240, 640, 480)
FLOW = np.array([[0.5, -1.0, 200.0], [1.0, 0.2, -90.0]])  # pixels per second


def tracks_of(seconds, n=200, wrong=0.0):
    rng = np.random.default_rng(0)
    now = rng.uniform((0, 0), (640, 480), (n, 2))
    before = now - seconds * (now @ FLOW[:, :2].T + FLOW[:, 2])
    before[: int(wrong * n)] += rng.uniform(-30, 30, (int(wrong * n), 2))
    return before, now


def test_the_flow_of_corners_is_found_though_some_are_wrong():
    assert affine_flow(tracks_of(0.05), 0.05, LENS) == pytest.approx(FLOW)
    found = affine_flow(tracks_of(0.05, wrong=0.3), 0.05, LENS)
    at = np.array([[0, 0, 1], [640, 480, 1]])
    assert at @ found.T == pytest.approx(at @ FLOW.T, abs=5)


@pytest.mark.parametrize(("seconds", "n"), [(0.0, 200), (5.0, 200), (0.05, 5)])
def test_few_corners_or_a_long_time_give_no_flow(seconds, n):
    assert affine_flow(tracks_of(seconds, n), seconds, LENS) is NO_FLOW


def test_rows_are_moved_to_the_time_of_the_pose():
    pixels, flow = np.array([[100.0, 0.0], [100.0, 240.0], [100.0, 480.0]]), np.array([[100.0, 10.0]] * 3)
    moved = LENS.compensate_rolling_shutter(pixels, flow, np.array([0.01, 0.02])) - pixels
    assert moved == pytest.approx(-flow * np.array([[0.0], [0.01], [0.02]]))


def test_a_recording_may_begin_with_frames_that_want_no_answer():
    pan = Pan(4, px=8)
    front_end = MotionFrontEnd(pan.camera)
    front_end.track_only(pan.image(0))
    front_end.track_only(pan.image(1))
    motion = front_end.measure(pan.image(2))
    assert motion is not None
    assert motion.status is not MotionStatus.TOO_FEW
    assert len(front_end.corners.pixels) > 50
