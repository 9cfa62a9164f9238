import sys
from pathlib import Path

import numpy as np
import pytest

from conformodal.corridor.path import rotation_world_cam
from conformodal.corridor.render import Renderer, same_views

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from turned_rooms_world import ROOM_X, TurnedRooms, half_turn, visiting_path


@pytest.fixture(scope="module")
def renderer():
    return Renderer(TurnedRooms(seed=0))


def pose(x, y, yaw_deg, z=1.3):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_world_cam(np.radians(yaw_deg))[0]
    matrix[:3, 3] = x, y, z
    return matrix


def test_a_half_turn_changes_place_and_heading_and_is_its_own_inverse():
    turned = half_turn(pose(3.0, 0.5, 20))
    np.testing.assert_allclose(turned, pose(-3.0, -0.5, 200), atol=1e-12)
    np.testing.assert_allclose(half_turn(turned), pose(3.0, 0.5, 20), atol=1e-12)


def test_views_of_a_flight_are_the_same_after_a_half_turn_but_for_the_poster(renderer):
    path = visiting_path(2, seed=3)
    outside = np.abs(path.positions_xyz[:, 0]) > ROOM_X
    assert outside.sum() > 40
    for i in range(0, len(path), 7):
        own = renderer.render(path.poses_se3[i]).astype(int)
        other = renderer.render(half_turn(path.poses_se3[i]))
        different = (np.abs(own - other) > 1).mean()  # rounding, at a few edges
        alike = same_views(renderer, path.poses_se3[i])
        assert (different < 1e-3) == (len(alike) == 1)
        if outside[i]:
            np.testing.assert_allclose(alike[0], half_turn(path.poses_se3[i]))
