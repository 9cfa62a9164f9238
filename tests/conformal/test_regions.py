import numpy as np

from conformodal.conformal import QuantileBins, Regions

BINS = QuantileBins.from_edges([[0.0, 1, 3, 6, 10], [0.0, 1, 2]])
MASKS = [np.array([[1, 0, 1, 1], [0, 0, 0, 0], [1, 1, 1, 1]], bool), np.array([[0, 1], [1, 1], [1, 0]], bool)]


def regions():
    return Regions(BINS, MASKS, np.zeros((3, 2), bool))


def test_intervals_are_merged_sorted_and_disjoint():
    first = regions().intervals(0)
    assert first[0].tolist() == [[0, 1], [3, 10]]
    assert first[1].tolist() == [[1, 2]]
    assert regions().intervals(1)[0].tolist() == []
    assert regions().n_intervals.tolist() == [[2, 1], [0, 1], [1, 1]]


def test_sizes():
    assert regions().length.tolist() == [[8, 1], [0, 2], [10, 1]]
    assert regions().volume.tolist() == [8, 0, 10]
    half_unbounded = Regions(BINS, MASKS, np.array([[True, False], [False, True], [False, False]]))
    assert half_unbounded.volume.tolist() == [np.inf, 0, 10]


def test_intervals_agree_with_random_masks_value_by_value():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 1, 13))])
    mask = rng.random((50, 12)) < 0.5
    found = Regions(bins, [mask], np.zeros((50, 1), bool))
    for i in range(50):
        for k, centre in enumerate(bins.centers[0]):
            assert any(a < centre < b for a, b in found.intervals(i)[0]) == mask[i, k]
    assert (found.n_intervals[:, 0] == [len(found.intervals(i)[0]) for i in range(50)]).all()


def test_indexing_and_membership():
    picked = regions()[np.array([2, 0])]
    assert len(picked) == 2
    assert picked.contains([[5.0, 0.5], [2.0, 1.5]]).tolist() == [[True, True], [False, True]]
    assert regions()[:1].contains([[10.0, 2.0]], joint=True).tolist() == [True]


def random_regions():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 1, 8)), [0.0, 0.1, 0.3]])
    masks = [rng.random((30, 7)) < 0.5, rng.random((30, 2)) < 0.5]
    return Regions(bins, masks, rng.random((30, 2)) < 0.1)


def test_concatenation_and_hull():
    r = random_regions()
    both = Regions.concatenate([r[:10], r[10:]])
    assert all(map(np.array_equal, both.masks, r.masks))
    for i in range(30):
        for j, intervals in enumerate(r.intervals(i)):
            hull = r.hull[i, j]
            assert np.isnan(hull).all() if len(intervals) == 0 else (hull == [intervals[0, 0], intervals[-1, 1]]).all()
