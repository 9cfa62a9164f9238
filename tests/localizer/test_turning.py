"""By how much images are turned, on a map whose keyframes look the same way with different rolls."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.conformal import QuantileBins
from conformodal.geometry import MotionStatus, RelativeMotion
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.sources.landmark_map import LandmarkMap
from conformodal.localizer.turning import TurnTracker
from tests.localizer.conftest import CAMERA, SIGN, Told

MOUNT = Rotation.from_euler("xyz", (100, 20, -30), degrees=True)  # of the camera on the rig whose poses are given


def roll(degrees):
    """About the camera's optical axis."""
    return Rotation.from_euler("z", degrees, degrees=True)


def map_of(*rolls):
    """Keyframes at one place that differ in roll alone."""
    n, mount = len(rolls), np.eye(4)
    mount[:3, :3] = MOUNT.as_matrix()
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = [(roll(angle) * MOUNT.inv()).as_matrix() for angle in rolls]
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8)
    rest = np.zeros((n, 4), np.float16), np.zeros(n + 1, np.int64), *nothing, np.zeros((n, 6)), 2.0
    return LandmarkMap(CAMERA, mount, np.zeros(2), np.array([1000.0, 0, 0]), poses, *rest)


@pytest.mark.parametrize(
    ("rolls", "rolled", "turn"),
    [([0], 20, 0), ([0], 70, 70), ([0], -100, -100), ([0, 90], 70, 0), ([0, 90], 170, 80), ([10], 190, 180)],
)
def test_image_turns_to_the_least_rolled_keyframe(rolls, rolled, turn):
    """Unless it is matched as it is."""
    expected = (roll(rolled) * MOUNT.inv()).as_quat(scalar_first=True)
    found = np.degrees(map_of(*rolls).turn_for(np.array([1000.1, 0, 0]), expected))
    assert np.mod(found - turn + 180, 360) - 180 == pytest.approx(0, abs=1e-6)


@dataclass(frozen=True, eq=False)
class Turner(Told):
    """Turns an image by the roll of the expected pose."""

    name: ClassVar[str] = "turner"
    local: ClassVar[bool] = True

    def turn_for(self, position_xyz, quat_wxyz):
        return float(Rotation.from_quat(quat_wxyz, scalar_first=True).as_euler("xyz")[2])


def estimate(degrees, probability=0.99):
    quat = roll(degrees).as_quat(scalar_first=True)
    return PoseMeasurement(np.zeros(3), quat, 0.1, 0.1, 50, probability)


def motion(degrees):
    return RelativeMotion(MotionStatus.OK, roll(degrees).as_matrix())


def test_roll_tracking_expires_without_recognition():
    """The roll is followed from the last recognised place, and doubted after five frames without one."""
    bins = QuantileBins.from_edges([np.linspace(0, 1, 3)] * 7)
    tracker = TurnTracker(Localizer((Turner(np.array([0])),), bins, SIGN))

    def step(moved, estimates=()):
        tracker.advance(moved)
        turn = np.degrees(tracker.turn_rad)
        tracker.observe(estimates)
        return pytest.approx(turn, abs=1e-9)

    assert step(None, [estimate(40, 0.5)]) == 0
    assert step(motion(50)) == 0  # no place was recognised so far
    assert step(motion(0), [estimate(40)]) == 0
    assert step(motion(10)) == 50
    assert step(None) == 50  # nothing is known of the motion: as before
    assert step(motion(20), [estimate(75), estimate(-20, 0.95)]) == 70
    assert [step(motion(1)) for _ in range(10)] == [76, 77, 78, 79, 80, 81, 82, 0, 84, 0]
    assert [step(motion(0)) for _ in range(60)][-8:] == [0] * 8  # forgotten
    assert step(motion(0), [estimate(40)]) == 0
    assert step(motion(0)) == 40
    tracker.reset()
    assert step(motion(30)) == 0
