"""Rooms of a model that a recording joins: their numbers in thresholds of images and of paths."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.localizer.rooms import Rooms
from conformodal.pipeline.extend import _with_rooms
from tests.small_model import small_model


def recording_along(start_m, end_m):
    """A recording of thirty frames along x."""
    targets = np.zeros((30, 7))
    targets[:, 0] = np.linspace(start_m, end_m, 30)
    return SimpleNamespace(targets=targets)


@pytest.fixture
def model():
    """A model of two rooms, 0 and 1, which are 100 m apart: scenes are 3 m deep."""
    model = small_model()
    positions = np.zeros((20, 3))
    positions[:, 0] = np.repeat([0.0, 100.0], 10) + np.tile(np.linspace(0, 1, 10), 2)
    return replace(model, rooms=Rooms(positions, np.repeat([0, 1], 10)))


def rooms_of_calibration(model):
    return [rule.rooms for rule in model.path_rules.values()]


def test_a_recording_elsewhere_is_a_room_of_its_own(model):
    rooms, joined = _with_rooms(model, recording_along(200, 201))
    assert len(np.unique(rooms.rooms)) == 3
    known = rooms.rooms[[0, 10]]  # of the two that there were
    np.testing.assert_array_equal(joined.rules.rooms, known[model.rules.rooms])
    for before, after in zip(rooms_of_calibration(model), rooms_of_calibration(joined), strict=True):
        np.testing.assert_array_equal(after, known[before])


def test_a_second_room_gives_the_first_one_its_number(model):
    one = replace(
        model,
        rooms=None,
        rules=replace(model.rules, rooms=None),
        path_rules={path: replace(rule, rooms=np.zeros_like(rule.rooms)) for path, rule in model.path_rules.items()},
    )
    rooms, joined = _with_rooms(one, recording_along(200, 201))
    first = rooms.rooms_of([SimpleNamespace(positions_xyz=np.zeros((1, 3)), log_weights=np.zeros(1))])
    assert len(np.unique(rooms.rooms)) == 2
    for each in (joined.rules.rooms, *rooms_of_calibration(joined)):
        assert np.unique(each).tolist() == first.tolist()


def test_a_recording_through_all_rooms_makes_them_one(model):
    through = recording_along(0, 1)
    through.targets[15:, 0] += 100
    rooms, joined = _with_rooms(model, through)
    assert rooms is joined.rules.rooms is None
    assert all(not each.any() for each in rooms_of_calibration(joined))
    assert any(each.any() for each in rooms_of_calibration(model))
