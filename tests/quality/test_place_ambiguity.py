"""Places in regions that were made by hand: how many are counted, and which stretches are said to look alike."""

from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.conformal import QuantileBins
from conformodal.corridor.ambiguity import AmbiguityCheck
from conformodal.geometry import Trajectory
from conformodal.localizer.region_rules import EvidenceType
from conformodal.quality.advice import describe_quality, record_next
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.place_ambiguity import ambiguity
from conformodal.quality.view_coverage import ViewScale
from tests.helpers import pose_regions_of

SCALE = ViewScale(depth_m=2.0, fov_rad=1.0)
BINS = QuantileBins.from_edges([np.linspace(0, 20, 41), *[np.array([-2.0, 0.0, 2.0])] * 6])
REFERENCE = np.array([1.0, 0, 0, 0])
# Two rooms of 40 known frames each, 10 m apart; frames 0 to 39 and 40 to 79.
IN_ROOM = 0.05 * np.arange(40)
X = np.concatenate((1 + IN_ROOM, 11 + IN_ROOM))


def at(x):
    n = len(x)
    zeros = np.zeros((n, 2))
    return Trajectory(np.arange(n, dtype=float), np.column_stack((x, zeros)), np.tile(REFERENCE, (n, 1)))


def regions(*parts):
    """One region a list of intervals along x, the whole range in all else; None for an unbounded set."""
    masks = [np.ones((len(parts), k), dtype=bool) for k in BINS.sizes]
    unbounded = np.zeros((len(parts), 7), dtype=bool)
    for i, intervals in enumerate(parts):
        if intervals is None:
            unbounded[i] = True
            continue
        masks[0][i] = False
        for low, high in intervals:
            masks[0][i] |= (BINS.centers[0] > low) & (BINS.centers[0] < high)
    return pose_regions_of(BINS, masks, unbounded)


def examined(parts, truth, known=X, frames=None):
    n = len(parts)
    found = SimpleNamespace(
        regions=regions(*parts),
        kinds=np.array([EvidenceType.UNKNOWN if part is None else EvidenceType.GLOBAL for part in parts]),
        candidates=[SimpleNamespace(positions_xyz=np.zeros((1, 3)), log_mass=np.zeros(1))] * n,
    )
    frames = np.arange(n) if frames is None else frames
    poses = None if truth is None else at(np.array(truth))
    return ambiguity(frames, np.zeros(n, dtype=np.int64), found, at(known), poses, REFERENCE, SCALE)


def of_a_recording(found, known_names):
    sequence, positions = SimpleNamespace(recording=np.zeros(1)), np.diag([2.0, 1.0, 0.0])
    poses = Trajectory(np.arange(3.0), positions, np.tile(REFERENCE, (3, 1)))
    return RecordingQuality(sequence, np.arange(3), poses, known_names, SCALE, None, found, [])


def test_places_in_a_region_are_counted():
    parts = [[(1, 3)], [(1, 2), (11, 12)], [(0, 20)], None]
    found = examined(parts, [1.5, 1.5, 1.5, 1.5])
    assert found.n_places.tolist() == [1, 2, 2, 0]
    assert found.n_unknown == 1


def test_places_that_known_frames_join_are_one():
    way = np.concatenate((X, np.linspace(3, 11, 160)))
    assert examined([[(0, 20)]], [1.5], way).n_places.tolist() == [1]
    # two intervals of one place, with a gap that is narrower than what counts as near
    assert examined([[(1, 1.5), (2, 2.5)]], [1.2]).n_places.tolist() == [1]
    # both sides of a stretch that nobody knows show some of the same: 0.75 of the view lies between them
    assert examined([[(0, 20)]], [1.5], X[(X < 1.5) | (X == 3.0)]).n_places.tolist() == [1]
    assert examined([[(0, 20)]], [1.5], np.array([1.0, 3.1])).n_places.tolist() == [2]


def test_the_frames_own_place_counts_where_its_region_misses_it():
    assert examined([[(11, 12)]], [1.5]).n_places.tolist() == [2]
    assert examined([[(11, 12)]], None).n_places.tolist() == [1]


def test_stretches_that_look_alike_are_named_by_known_frames():
    parts = [[(1, 3)]] * 10 + [[(1, 2), (11.5, 12.5)]] * 5 + [[(1, 3)]] * 10
    frames = 100 + 2 * np.arange(25)
    found = examined(parts, [1.5] * 25, frames=frames)
    (one,) = found.stretches
    assert (one.first, one.last, one.n_frames, one.n_places) == (120, 128, 5, 2)
    assert one.place_xyz == (1.5, 0.0, 0.0)
    # x from 11.5 to 12.5, of frames that stand at 11 + 0.05 (i - 40)
    ((first, last),) = one.alike
    assert (first, last) == (50, 69)


@pytest.mark.parametrize(("n", "frames"), [(5, "frames 20 to 28"), (1, "frame 20")])
def test_what_looks_alike_is_to_be_recorded_in_one_piece(n, frames):
    parts = [[(1, 3)]] * 10 + [[(1, 2), (11.5, 12.5)]] * n
    found = examined(parts, [1.5] * len(parts), frames=2 * np.arange(len(parts)))
    quality = of_a_recording(found, 1000 + np.arange(80))
    (advice,) = record_next(quality)
    assert advice.startswith(f"Places look alike: {frames} (around x=1.5, y=0.0) and frames 1050 to 1069. Record")
    assert describe_quality(quality)[0].startswith(f"ambiguous: {n} of {10 + n} frames that the model has not seen; ")


def test_a_stretch_that_looks_like_itself_is_not_sent_from_one_end_to_the_other():
    parts = [[(1, 3)]] * 10 + [[(1, 2), (11.5, 12.5)]] * 5
    found = examined(parts, [1.5] * len(parts), frames=2 * np.arange(len(parts)))
    (one,) = found.stretches
    # the known frames elsewhere, 50 to 69 of all, bear the numbers 10 to 29: those of the stretch itself
    (advice,) = record_next(of_a_recording(found, np.arange(80) - 40))
    assert (one.first, one.last) == (20, 28)
    assert advice.startswith("Places look alike: frames 20 to 28 (around x=1.5, y=0.0). Record")


def test_the_share_of_places_that_look_the_same_counts_all_frames():
    places, held = [np.zeros((3, 3)), np.zeros((1, 3)), np.empty((0, 3))], [[True, False, True], [True], []]
    found = AmbiguityCheck(places, [np.array(one, dtype=bool) for one in held]).record()
    assert found == {"n_frames": 2, "n_places": 4, "share_held": 0.75}
