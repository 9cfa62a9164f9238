import numpy as np
import pytest

from conformodal.pipeline.evaluate import RegionStatistics, coverage_by_size


def statistics(length, held, unbounded=()):
    n = len(length)
    whole = np.zeros((n, 7), dtype=bool)
    whole[list(unbounded), 2] = True
    every = np.ones((n, 7))
    sizes = every * np.asarray(length, dtype=float)[:, None]
    return RegionStatistics(every > 0, sizes, every.astype(int), whole, np.zeros(n, int), held, np.ones(n, int))


def test_coverage_is_told_for_each_tenth_of_the_sizes():
    """Of a hundred regions in random order, those of the smallest tenth miss the pose, and no other does."""
    order = np.random.default_rng(0).permutation(100)
    table = coverage_by_size(statistics(1.0 + order, order >= 10))
    assert [row["frames"] for row in table] == [10] * 10
    assert [row["coverage"] for row in table] == [0.0] + [1.0] * 9
    assert [row["median_length_m"] for row in table] == [10 * k + 5.5 for k in range(10)]


@pytest.mark.parametrize(("n", "rows"), [(0, 0), (1, 1), (19, 1), (20, 2), (99, 9), (500, 10)])
def test_a_row_has_ten_frames_or_more(n, rows):
    table = coverage_by_size(statistics(np.arange(n), np.ones(n, dtype=bool)))
    assert len(table) == rows
    assert sum(row["frames"] for row in table) == n


def test_unbounded_regions_are_left_out():
    table = coverage_by_size(statistics([1, 2, 3], np.array([True, False, True]), unbounded=[0]))
    assert table == [{"frames": 2, "median_length_m": 2.5, "coverage": 0.5}]
