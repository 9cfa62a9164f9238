"""Regions as Arrow tables (the optional extra ``arrow``).

One row a sample; one column ``target_J`` a target, ``list<fixed_size_list<double>[2]>``: the sorted, disjoint
intervals, ``[-inf, inf]`` for an unbounded set, an empty list for an empty set. The schema's metadata holds the edges,
key ``conformodal.edges``, as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray

from .bins import QuantileBins
from .errors import ConformalError

if TYPE_CHECKING:
    import pyarrow as pa

_EDGES = b"conformodal.edges"


def _need_pyarrow() -> None:
    try:
        import pyarrow  # noqa: F401, PLC0415
    except ImportError:
        raise ConformalError("Arrow and Parquet need pyarrow: pip install 'conformodal[arrow]'") from None


def to_table(bins: QuantileBins, intervals: Sequence[tuple[IntArray, FloatArray]]) -> pa.Table:
    """Arrow table of each target's offsets (n + 1,) and ends (m, 2); the columns are in the module's description."""
    _need_pyarrow()
    import pyarrow as pa  # noqa: PLC0415

    columns = []
    for offsets, ends in intervals:
        pairs = pa.FixedSizeListArray.from_arrays(pa.array(ends.ravel().astype(np.float64, copy=False)), 2)
        columns.append(pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pairs))
    edges = json.dumps([e.tolist() for e in bins.edges_])
    names = [f"target_{j}" for j in range(len(columns))]
    return pa.table(columns, names=names).replace_schema_metadata({_EDGES: edges.encode()})
