"""Regions of the rows of a table as a table, in one schema."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from joblib import Parallel, delayed
from sklearn.utils import gen_batches
from threadpoolctl import ThreadpoolController

from conformodal.core.arrays import BoolArray
from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra

from .bins import QuantileBins
from .checks import Alpha, BinProbabilities, brief
from .density.encoder import is_time, numpy_columns
from .doubts import TableMemory
from .predictive import PredictiveDensity
from .regions import Regions

_ROWS = 4096  # of a block, of which each thread holds several arrays (rows, bins)


class TableRegressor(Protocol):
    """What is asked of a fitted :class:`~conformodal.conformal.ConformalRegressor`, which calls this module."""

    bins_: QuantileBins
    columns_: list[str]
    group_column_: Any
    memory_: TableMemory

    def compare_rows(self, features: Any) -> BoolArray:
        """Whether the set of each row is unbounded, (n,); warns of unlike rows."""
        ...

    def warn_without_group(self, groups: Any) -> None:
        """Warn of rows without a label."""
        ...

    def proba_of(self, features: Any) -> BinProbabilities:
        """Probabilities of the bins."""
        ...

    def regions_of(self, proba: BinProbabilities, unlike: BoolArray, alpha: Alpha | None, groups: Any) -> Regions:
        """Regions of rows with these probabilities."""
        ...


def input_columns(reg: TableRegressor, names: list[str]) -> list[str]:
    """The columns of a table with these names that a regressor reads, in its order; missing ones are refused."""
    if not reg.columns_:
        raise ConformodalError("tables are read by the names of their columns: fit on a frame, not on an array")
    group = _group_name(reg)
    needed = [*reg.columns_, *([] if group is None or group in reg.columns_ else [group])]
    if missing := [name for name in needed if name not in names]:
        raise ConformodalError(f"the table lacks the columns {brief(missing, 200)}; it has {brief(names, 200)}")
    return needed


def output_columns(targets: Sequence[str], more: Sequence[str] = ()) -> list[str]:
    """Names of the columns of regions of these targets, after `more` columns; equal ones are refused."""
    names = [*more, *(f"{target}{end}" for target in targets for end in ("", "_low", "_high", "_intervals"))]
    if twice := [name for name, times in Counter(names).items() if times > 1]:
        raise ConformodalError(f"target names {brief(targets)} lead to several columns {brief(twice)}; rename a target")
    return names


def _group_name(reg: TableRegressor) -> str | None:
    """The column of groups, by its name in a table, which is text."""
    return None if reg.group_column_ is None else str(reg.group_column_)


def as_inputs(reg: TableRegressor, table: Any) -> Any:
    """The columns of a table of pandas, polars or Arrow that a regressor reads, as a frame of pandas.

    Text in a column that held dates is read as dates if the year comes first.
    """
    names = list(map(str, getattr(table, "column_names", getattr(table, "columns", ()))))
    needed = input_columns(reg, names)
    if hasattr(table, "iloc"):
        table = table.copy(deep=False)
        table.columns = names  # pandas allows other names than text, such as the default 0, 1
    frame = numpy_columns(table[needed] if hasattr(table, "iloc") else table.select(needed))
    frame = frame if hasattr(frame, "iloc") else frame.to_pandas()
    for name, memory in zip(reg.columns_, reg.memory_.columns, strict=False):
        column = frame[name]
        if hasattr(reg, "file_format_") and getattr(column.dtype, "tz", None) is not None:
            frame = frame.assign(**{name: column.dt.tz_convert(None)})  # files are read so, in UTC
        if not memory.dated or column.dtype.kind == "M" or is_time(column):
            continue
        with require_extra("table", "reading text as dates"):
            import pandas as pd  # noqa: PLC0415 - an extra
        text = column.astype("str")
        dates = pd.to_datetime(text.where(column.notna()), format="ISO8601", utc=True, errors="coerce")
        others = column.notna() & ~(dates.notna() & text.str.match(r"\d{4}\D|\d{8}T"))
        others |= column.notna() & (column.dtype.kind in "biuf")
        if others.any():
            row = int(others.to_numpy().argmax())
            shown = f"got {brief(column.iloc[row])} in row {row} (from 0)"
            raise ConformodalError(f"column {name} held dates in training, {shown}: convert it with pandas.to_datetime")
        frame = frame.assign(**{name: dates if memory.zone else dates.dt.tz_localize(None)})
    return frame


def region_table(reg: TableRegressor, table: Any, alpha: Alpha | None) -> Any:
    """See :meth:`ConformalRegressor.predict_table`; rows are answered in blocks, so that memory stays bounded.

    Blocks are answered by as many threads as :func:`joblib.parallel_config` allows, by default one.
    """
    with require_extra("table", "predict_table"):
        import pyarrow as pa  # noqa: PLC0415 - an extra

        output_columns(reg.bins_.target_names)
        frame = as_inputs(reg, table)
    inputs, group = frame[reg.columns_], _group_name(reg)
    unlike = reg.compare_rows(inputs)
    if group is not None and group not in reg.columns_:  # else compare_rows tells of gaps
        reg.warn_without_group(frame[group])
    threads = ThreadpoolController()

    def answer(rows: slice) -> Any:
        with threads.limit(limits=1, user_api="openmp"):  # which each thread has a limit of its own for
            proba = reg.proba_of(inputs.iloc[rows])
        labels = None if group is None else frame[group].iloc[rows]
        return _arrow_table(reg, proba, reg.regions_of(proba, unlike[rows], alpha, labels))

    parts = [*gen_batches(len(frame), _ROWS)] or [slice(0, 0)]
    with threads.limit(limits=1):  # threads within a block would wait more than they work
        result = pa.concat_tables(Parallel(require="sharedmem")(delayed(answer)(rows) for rows in parts))
    if hasattr(table, "iloc"):
        return result.to_pandas().set_index(table.index)
    return result if hasattr(table, "column_names") else type(table)(result)  # of Arrow, of polars


def _arrow_table(reg: TableRegressor, proba: BinProbabilities, regions: Regions) -> Any:
    """An Arrow table: of each target the mean, the ends of the set and its intervals with their probabilities."""
    import pyarrow as pa  # noqa: PLC0415 - an extra

    density, columns = PredictiveDensity(regions.bins, proba), {}
    mean, hull = density.mean, regions.hull
    for j, name in enumerate(regions.bins.target_names):
        offsets, ends = regions.flat_intervals(j)
        fields = {"low": ends[:, 0], "high": ends[:, 1], "probability": density.flat_probabilities(regions, j)}
        struct = pa.StructArray.from_arrays([pa.array(values) for values in fields.values()], list(fields))
        empty: BoolArray = np.diff(offsets) == 0
        columns[name] = pa.array(mean[:, j])
        columns[f"{name}_low"], columns[f"{name}_high"] = (pa.array(end, mask=empty) for end in hull[:, j].T)
        columns[f"{name}_intervals"] = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), struct)
    return pa.table(columns)
