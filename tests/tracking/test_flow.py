import numpy as np
import pytest

from conformodal.geometry import PinholeCamera
from conformodal.geometry.camera import NO_FLOW
from conformodal.tracking.tracker import affine_flow

CAMERA = PinholeCamera(500, 500, 320, 240, 640, 480)
FLOW = np.array([[0.5, -1.0, 200.0], [1.0, 0.2, -90.0]])  # pixels per second


def tracks_of(seconds, n=200, wrong=0.0):
    rng = np.random.default_rng(0)
    now = rng.uniform((0, 0), (640, 480), (n, 2))
    before = now - seconds * (now @ FLOW[:, :2].T + FLOW[:, 2])
    before[: int(wrong * n)] += rng.uniform(-30, 30, (int(wrong * n), 2))
    return before, now


def test_the_flow_of_corners_is_found_though_some_are_wrong():
    assert affine_flow(tracks_of(0.05), 0.05, CAMERA) == pytest.approx(FLOW)
    found = affine_flow(tracks_of(0.05, wrong=0.3), 0.05, CAMERA)
    at = np.array([[0, 0, 1], [640, 480, 1]])
    assert at @ found.T == pytest.approx(at @ FLOW.T, abs=5)


@pytest.mark.parametrize(("seconds", "n"), [(0.0, 200), (5.0, 200), (0.05, 5)])
def test_few_corners_or_a_long_time_give_no_flow(seconds, n):
    assert affine_flow(tracks_of(seconds, n), seconds, CAMERA) is NO_FLOW


def test_rows_are_moved_to_the_time_of_the_pose():
    pixels, flow = np.array([[100.0, 0.0], [100.0, 240.0], [100.0, 480.0]]), np.array([[100.0, 10.0]] * 3)
    moved = CAMERA.at_pose_time(pixels, flow, np.array([0.01, 0.02])) - pixels
    assert moved == pytest.approx(-flow * np.array([[0.0], [0.01], [0.02]]))
