import numpy as np
import pytest

from conformodal.conformal import ConformalError, QuantileBins, Regions


def regions():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 1, 8)), [0.0, 0.1, 0.3]])
    masks = [rng.random((30, 7)) < 0.5, rng.random((30, 2)) < 0.5]
    return Regions(bins, masks, rng.random((30, 2)) < 0.1)


def test_parquet_round_trip(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    before = regions()
    parquet.write_table(before.to_arrow(), tmp_path / "r.parquet")
    after = Regions.from_arrow(parquet.read_table(tmp_path / "r.parquet"))
    np.testing.assert_array_equal(after.unbounded, before.unbounded)
    for a, b in zip(after.masks, before.masks, strict=True):
        np.testing.assert_array_equal(a, b)
    assert all(map(np.array_equal, after.bins.edges_, before.bins.edges_))


def test_errors_name_the_column():
    pytest.importorskip("pyarrow")
    with pytest.raises(ConformalError, match="target_1"):
        Regions.from_arrow(regions().to_arrow().drop_columns(["target_1"]))


def test_concatenation_intersection_and_hull():
    r = regions()
    both = Regions.concatenate([r[:10], r[10:]])
    assert all(map(np.array_equal, both.masks, r.masks))
    np.testing.assert_array_equal((r & r).masks[0], r.masks[0])
    for i in range(30):
        for j, intervals in enumerate(r.intervals(i)):
            hull = r.hull[i, j]
            assert np.isnan(hull).all() if len(intervals) == 0 else (hull == [intervals[0, 0], intervals[-1, 1]]).all()
