import cv2
import numpy as np
import pytest

from conformodal.geometry import PinholeCamera
from conformodal.io import ImageError
from conformodal.tracking.motions import frame_features
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


def test_the_flow_is_right_where_corners_are_renewed_between_answers():
    flows = flows_of_a_run(Pan(11, px=60), 5)
    for i in (5, 10):
        assert middle(flows[i]) == pytest.approx([-60 * HZ, 0], abs=30)


@pytest.mark.parametrize("every", [1, 4, 10])
def test_runs_have_the_flow_that_training_has(every):
    pan = Pan(21, px=8, unreadable=(7, *range(11, 20)))
    for i, flow in flows_of_a_run(pan, every).items():
        expected = [-8 * HZ if 0 < i < 20 else 0, 0]  # the last frame that can be read before 20 is 0.33 s ago
        for one in (flow, frame_features(pan, i).flow):
            assert middle(one) == pytest.approx(expected, abs=4), i
