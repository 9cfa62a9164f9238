import json

import numpy as np
import pytest

from conformodal.conformal import QuantileBins, Regions


def regions():
    rng = np.random.default_rng(0)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 1, 8)), [0.0, 0.1, 0.3]])
    masks = [rng.random((30, 7)) < 0.5, rng.random((30, 2)) < 0.5]
    return Regions(bins, masks, rng.random((30, 2)) < 0.1)


def test_a_parquet_file_holds_intervals_and_edges(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    before = regions()
    parquet.write_table(before.to_arrow(), tmp_path / "r.parquet")
    after = parquet.read_table(tmp_path / "r.parquet")
    edges = json.loads(after.schema.metadata[b"conformodal.edges"])
    assert edges == [e.tolist() for e in before.bins.edges_]
    assert after.column_names == ["target_0", "target_1"]
    columns = [after.column(name).to_pylist() for name in after.column_names]
    for i in range(len(before)):
        for column, intervals in zip(columns, before.intervals(i), strict=True):
            assert column[i] == intervals.tolist()


def test_concatenation_and_hull():
    r = regions()
    both = Regions.concatenate([r[:10], r[10:]])
    assert all(map(np.array_equal, both.masks, r.masks))
    for i in range(30):
        for j, intervals in enumerate(r.intervals(i)):
            hull = r.hull[i, j]
            assert np.isnan(hull).all() if len(intervals) == 0 else (hull == [intervals[0, 0], intervals[-1, 1]]).all()
