"""When whole recordings take the place of stretches in the calibration of an extended model."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from conformodal.pipeline.guarantee import describe_guarantee, short_guarantee
from conformodal.pipeline.model import JournalEntry
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.whole_recordings import calibrate_by_recordings, describe_units, n_recordings_needed
from tests.small_model import small_model


def grown(alpha):
    """A model whose last 15 of 20 stretches, of three frames each, are of three recordings that joined."""
    model = small_model()
    model.recalibrate(alpha)
    numbers = {"coverage": 0.9, "bounded": 1.0, "reliable": 0.5, "median_m": 0.1}
    numbers |= {"path_coverage": None, "path_bounded": None}
    entries = [
        JournalEntry(name=f"day {k}", date="2026-01-01", n_frames=15, first_unit=5 + 5 * k, n_units=5, **numbers)
        for k in range(3)
    ]
    return replace(model, journal=tuple(entries))


def test_enough_recordings_are_those_of_a_finite_threshold():
    assert [n_recordings_needed(grown(alpha)) for alpha in (0.5, 0.2, 0.1, 0.05)] == [1, 4, 9, 19]


@pytest.mark.parametrize("alpha", [0.2, 0.3])
def test_stretches_stay_where_recordings_are_too_few(alpha):
    """At 0.3 three recordings are enough, but not for the half of the frames in which a place was recognised."""
    model = grown(alpha)
    assert (n_recordings_needed(model) <= 3) == (alpha == 0.3)
    assert calibrate_by_recordings(model) is model
    assert describe_units(model).startswith("Stretches calibrate: 20, those of 3 recordings")


@pytest.mark.parametrize("first", [True, False])
def test_recordings_without_poses_do_not_calibrate(first):
    numbers = {"coverage": None, "bounded": 1.0, "path_coverage": None, "path_bounded": None}
    numbers |= {"reliable": 0.5, "median_m": None, "first_unit": 0, "n_units": 0}
    alone = JournalEntry(name="walk.mp4", date="2026-01-01", n_frames=40, **numbers)

    def joined(model):
        return replace(model, journal=(alone, *model.journal) if first else (*model.journal, alone))

    stretches, recordings = joined(grown(0.2)), joined(grown(0.6))
    assert calibrate_by_recordings(stretches) is stretches  # four are needed
    assert "those of 3 recordings" in describe_units(stretches)
    text = describe_guarantee(stretches)
    assert "3 recordings joined after training, each judged" in text
    assert "1 recording without poses joined" in text
    after, without = calibrate_by_recordings(recordings), calibrate_by_recordings(grown(0.6))
    np.testing.assert_array_equal(after.calibration.units_, without.calibration.units_)
    assert describe_units(after).startswith("Whole recordings calibrate: 3, of which 3 joined")
    lonely = replace(grown(0.6), journal=(alone,))
    assert calibrate_by_recordings(lonely) is lonely
    assert "of the same recording" in short_guarantee(lonely)


def test_recordings_replace_the_training_stretches(tmp_path):
    before = grown(0.6)
    after = calibrate_by_recordings(before)
    assert after is not before
    np.testing.assert_array_equal(after.calibration.units_, np.repeat([5, 6, 7], 15))
    np.testing.assert_array_equal(after.calibration.scores_, before.calibration.scores_[15:])
    np.testing.assert_array_equal(after.rules.known_p, before.rules.known_p[15:])
    for path, rule in after.path_rules.items():
        np.testing.assert_array_equal(rule.calibration.scores_, before.path_rules[path].calibration.scores_[15:])
        assert set(rule.calibration.unit_sizes_) == {15}
    assert after.novelty is before.novelty  # its p-values keep the scale of the significance level
    assert "new recording" in short_guarantee(after)
    assert describe_units(after).startswith("Whole recordings calibrate: 3")
    save_model(after, tmp_path)
    loaded = load_model(tmp_path)
    np.testing.assert_allclose(loaded.calibration.thresholds_, after.calibration.thresholds_)
    assert calibrate_by_recordings(loaded) is loaded


def test_stretches_stay_where_paths_would_be_unbounded():
    before = grown(0.6)
    paths = {}
    for path, rule in before.path_rules.items():
        calibration = copy(rule.calibration)
        rows = np.flatnonzero(calibration.units_ < 6)  # of the later recordings, three frames were found
        scores, units, sizes = (getattr(calibration, name)[rows] for name in ("scores_", "units_", "unit_sizes_"))
        calibration.calibrate_scores(scores, units, sizes)
        of_rows = {name: getattr(rule, name)[rows] for name in ("squared", "known_p", "rooms")}
        paths[path] = replace(rule, calibration=calibration, **of_rows)
    model = replace(before, path_rules=paths)
    assert all(np.isfinite(rule.calibration.thresholds_).all() for rule in model.path_rules.values())
    assert calibrate_by_recordings(model) is model
