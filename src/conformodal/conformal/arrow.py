"""Regions as Arrow tables (the optional extra ``arrow``).

One row a sample; one column ``target_J`` a target, ``list<fixed_size_list<double>[2]>``: the sorted, disjoint
intervals, ``[-inf, inf]`` for the whole space, an empty list for an empty set. The schema's metadata holds the edges,
key ``conformodal.edges``, as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from conformodal.core import BoolArray, FloatArray, IntArray

from .bins import QuantileBins
from .checks import as_doubles
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


def from_table(table: pa.Table) -> tuple[QuantileBins, list[BoolArray], BoolArray]:
    """Bins, masks and unbounded flags of a table that :func:`to_table` made.

    Raises
    ------
    ConformalError
        If the edges or a column are missing or damaged, a value is missing, or an interval does not start and end on
        edges.
    """
    _need_pyarrow()
    import pyarrow as pa  # noqa: PLC0415

    if not isinstance(table, pa.Table):
        raise ConformalError(f"table must be an Arrow table, got {type(table).__name__}")
    raw = (table.schema.metadata or {}).get(_EDGES)
    if raw is None:
        raise ConformalError("table has no 'conformodal.edges' in its metadata; it was not made by Regions.to_arrow")
    try:
        bins = QuantileBins.from_edges(json.loads(raw))
    except ValueError as exc:  # of JSON, of its text, and of the edges
        raise ConformalError(f"the table's 'conformodal.edges' are no edges: {exc}") from None
    masks, unbounded = [], np.zeros((table.num_rows, bins.n_targets), dtype=bool)
    for j, edges in enumerate(bins.edges_):
        name = f"target_{j}"
        if name not in table.column_names:
            raise ConformalError(f"table has no column {name!r}; found {table.column_names}")
        counts, ends = _ends(table.column(name), name)
        rows = np.repeat(np.arange(table.num_rows), counts)
        whole = np.isinf(ends).all(axis=1)
        unbounded[rows[whole], j] = True
        at = np.searchsorted(edges, ends[~whole])
        outside = (at >= edges.size).any() or not np.array_equal(edges[at], ends[~whole])
        if outside or (at[:, 0] >= at[:, 1]).any() or (ends[whole] != (-np.inf, np.inf)).any():
            raise ConformalError(f"column {name!r} holds an interval that does not start and end on the edges")
        steps = np.zeros((table.num_rows, edges.size), dtype=np.int8)
        np.add.at(steps, (rows[~whole], at[:, 0]), 1)
        np.add.at(steps, (rows[~whole], at[:, 1]), -1)
        masks.append(steps.cumsum(axis=1)[:, :-1] > 0)
    return bins, masks, unbounded


def _ends(chunks: pa.ChunkedArray, name: str) -> tuple[IntArray, FloatArray]:
    """Intervals a row (n,), and the ends of all (m, 2)."""
    import pyarrow as pa  # noqa: PLC0415

    try:
        column = pa.concat_arrays(chunks.chunks) if chunks.num_chunks else pa.array([], chunks.type)
        pairs = column.flatten()
        numbers = pairs.flatten()
        counts = np.asarray(column.value_lengths(), dtype=np.float64)
        lengths = np.full(len(pairs), 2) if pa.types.is_fixed_size_list(pairs.type) else pairs.value_lengths()
        missing = column.null_count + pairs.null_count + numbers.null_count
        if missing or len(numbers) != 2 * len(pairs) or (np.asarray(lengths) != 2).any():
            raise ConformalError(f"column {name!r} holds a missing value, or an interval without two ends")
        return counts.astype(np.int64), as_doubles(numbers, f"column {name!r}").reshape(-1, 2)
    except (pa.ArrowException, AttributeError, TypeError):
        raise ConformalError(f"column {name!r} must hold lists of pairs of numbers, got {chunks.type}") from None
