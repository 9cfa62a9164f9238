"""Places in regions that were made by hand: how many are counted, and which stretches look alike."""

from types import SimpleNamespace

import numpy as np

from conformodal.geometry import Trajectory
from conformodal.localizer.observations import Place
from conformodal.localizer.regions import EvidenceType
from conformodal.quality.advice import advice, verdict
from conformodal.quality.examining import RecordingQuality
from conformodal.quality.view_coverage import ViewScale, ambiguity

SCALE = ViewScale(depth_m=2.0, fov_rad=1.0)  # places of which more than 2 m apart show nothing in common
FORWARD = np.array([1.0, 0, 0, 0])


def answers(*frames):
    """One region per list of places along x, the most probable first; None for an unbounded region."""
    places = [[Place(np.array([x, 0, 0]), FORWARD, np.ones(3), 0.1, 0.5) for x in one or []] for one in frames]
    unbounded = np.array([[one is None] * 7 for one in frames])
    kinds = np.array([EvidenceType.UNKNOWN if one is None else EvidenceType.GLOBAL for one in frames])
    length = np.where(unbounded, np.inf, 0.5 * np.array([[len(one)] * 7 for one in places]))
    regions = SimpleNamespace(unbounded=unbounded, places=lambda i: places[i], length=length)
    return SimpleNamespace(regions=regions, kinds=kinds)


def examined(*frames, numbers=None):
    n = len(frames)
    numbers = np.arange(n) if numbers is None else numbers
    return ambiguity(numbers, np.zeros(n, dtype=np.int64), answers(*frames), SCALE)


def test_places_in_a_region_are_counted():
    places = examined([1.5], [1.5, 11.5], [1.5, 11.5, 21.5], None)
    assert places.n_places.tolist() == [1, 2, 3, 0]
    assert places.n_unknown == 1
    assert (places.n_bounded, places.median_length) == (3, (1.0, 1.0, 1.0))


def test_places_whose_views_have_something_in_common_are_one():
    assert examined([1.5, 3.0], [1.5, 3.0, 4.5], [1.5, 4.0]).n_places.tolist() == [1, 2, 2]


def test_ambiguous_stretches_name_frames_and_places():
    frames = [[1.5]] * 10 + [[1.5, 11.5]] * 5 + [[1.5]] * 10
    places = examined(*frames, numbers=100 + 2 * np.arange(25))
    (one,) = places.stretches
    assert (one.first, one.last, one.distance_m) == (120, 128, 10.0)
    assert (one.place_xyz, one.alike_xyz) == ((1.5, 0.0, 0.0), (11.5, 0.0, 0.0))
    poses = Trajectory(np.arange(3.0), np.diag([2.0, 1.0, 0.0]), np.tile(FORWARD, (3, 1)))
    sequence = SimpleNamespace(recording=np.zeros(1), unit="m")
    quality = RecordingQuality(sequence, np.arange(3), poses, np.arange(3), SCALE, None, places)
    (line,) = advice(quality)
    for named in ("frames 120 to 128", "x=1.5", "x=11.5"):
        assert named in line
    assert verdict(quality).startswith("good enough: yes, but ambiguous")
