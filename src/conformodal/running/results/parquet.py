"""Regions as a Parquet file (extra ``arrow``): one row a frame, one column a target.

``timestamp_s``, ``place_p`` and ``known_p`` double, ``reliable`` bool, ``frame``, ``evidence`` and ``motion`` strings;
then for each target a column ``list<fixed_size_list<double>[2]>``: sorted, disjoint intervals, ``[-inf, inf]`` for the
whole line, an empty list for an empty set. ``places`` and ``path_places`` are lists of structs, as in
``regions.jsonl``; ends of boxes are infinite where they have no bound. It holds what ``regions.jsonl`` holds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from conformodal.core.files import replacing
from conformodal.localization.targets import TARGET_NAMES
from conformodal.model.errors import ResultsError

from .records import REGIONS, iter_region_records

FILE = "regions.parquet"
_ROWS_AT_A_TIME = 2000
_PLACES = ("places", "path_places")
_PLAIN = ("timestamp_s", "frame", "reliable", "place_p", "known_p", "evidence", "motion")


def write_region_parquet(folder: Path) -> Path:
    """Write ``regions.parquet`` from the ``regions.jsonl`` beside it, in constant memory; returns its path."""
    pa, pq = _pyarrow()
    interval = pa.list_(pa.list_(pa.float64(), 2))
    kinds = {"timestamp_s": pa.float64(), "reliable": pa.bool_(), "known_p": pa.float64(), "place_p": pa.float64()}
    fields = [(name, kinds.get(name, pa.string())) for name in _PLAIN]
    place = pa.struct(
        [("p", pa.float64()), ("sigma_rad", pa.float64()), ("box", interval)]
        + [(name, pa.list_(pa.float64())) for name in ("position_xyz", "orientation_quat_wxyz", "sigma_m")]
    )
    places = ((name, pa.list_(place)) for name in _PLACES)
    schema = pa.schema([*fields, *((name, interval) for name in TARGET_NAMES), *places])
    path = folder / FILE
    with replacing(path) as part, pq.ParquetWriter(part, schema) as writer:
        coming = iter_region_records(folder / REGIONS)
        while records := list(islice(coming, _ROWS_AT_A_TIME)):  # itertools.batched came with Python 3.12
            rows = [
                {
                    **{name: _text(r.get(name)) for name, _ in fields},
                    **{k: _bounded(v) for k, v in r["intervals"].items()},
                    **{k: _with_boxes(r.get(k), _bounded) for k in _PLACES},
                }
                for r in records
            ]
            writer.write_table(pa.Table.from_pylist(rows, schema))
    return path


def read_region_parquet(path: Path) -> list[dict[str, Any]]:
    """Records as :func:`~conformodal.running.results.records.read_region_records` gives them.

    Raises
    ------
    ResultsError
        If pyarrow is not installed, or the file is no such file.
    """
    pa, pq = _pyarrow()
    try:
        return list(_records(pq.read_table(path).to_pylist()))
    except (OSError, pa.ArrowException, KeyError, TypeError) as exc:
        raise ResultsError(f"{path}: is no file of regions: {type(exc).__name__}: {exc}") from exc


def _records(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for row in rows:
        intervals = {name: _open_ends(row.pop(name)) for name in TARGET_NAMES}
        places = {name: _with_boxes(row.get(name), _open_ends) for name in _PLACES}
        yield {**{k: row.get(k) for k in _PLAIN}, "intervals": intervals, **places}


def _with_boxes(places: list[dict[str, Any]] | None, change: Callable[[Any], Any]) -> list[dict[str, Any]] | None:
    return None if places is None else [{**place, "box": change(place["box"])} for place in places]


def _open_ends(parts: list[list[float]]) -> list[list[float | None]]:
    return [[_open(a), _open(b)] for a, b in parts]


def _bounded(parts: list[list[float | None]]) -> list[list[float]]:
    return [[-math.inf if a is None else a, math.inf if b is None else b] for a, b in parts]


def _text(value: Any) -> Any:
    """Undecodable bytes of a file name with backslashes: Arrow has UTF-8 only."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _open(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa  # noqa: PLC0415 - an extra
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ModuleNotFoundError as exc:
        raise ResultsError("Parquet needs pyarrow: pip install 'conformodal[arrow]'") from exc
    return pa, pq
