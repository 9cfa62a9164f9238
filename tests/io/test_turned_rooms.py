import sys
from pathlib import Path

import numpy as np
import pytest

from conformodal.corridor import Renderer, same_views

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from turned_rooms_world import ROOM_X, TurnedRooms, half_turn, visiting_path


@pytest.fixture(scope="module")
def renderer():
    return Renderer(TurnedRooms(seed=0))


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
