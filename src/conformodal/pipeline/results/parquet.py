"""Regions as a Parquet file (extra ``arrow``): one row a frame, one column a target.

``timestamp_s``, ``place_p`` and ``known_p`` double, ``reliable`` bool, ``frame``, ``evidence`` and ``motion`` strings;
then for each target a column ``list<fixed_size_list<double>[2]>``: sorted, disjoint intervals, ``[-inf, inf]`` for the
whole line, an empty list for an empty set. ``places`` and ``path_places`` are lists of structs, as in
``regions.jsonl``; ends of boxes are infinite where they have no bound. It holds what ``regions.jsonl`` holds.
"""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path
from typing import Any

from conformodal.core.extras import require_extra
from conformodal.core.files import replacing
from conformodal.core.words import as_utf8
from conformodal.localizer.targets import TARGET_NAMES

from .records import REGIONS, iter_region_records

FILE = "regions.parquet"
_ROWS_AT_A_TIME = 2000
_PLACES = ("places", "path_places")
_PLAIN = ("timestamp_s", "frame", "reliable", "place_p", "known_p", "evidence", "motion")


def write_region_parquet(folder: Path) -> Path:
    """Write ``regions.parquet`` from the ``regions.jsonl`` beside it, in constant memory; returns its path."""
    with require_extra("arrow", "Parquet"):
        import pyarrow as pa  # noqa: PLC0415 - an extra
        import pyarrow.parquet as pq  # noqa: PLC0415
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
                    **{k: _with_boxes(r.get(k)) for k in _PLACES},
                }
                for r in records
            ]
            writer.write_table(pa.Table.from_pylist(rows, schema))
    return path


def _with_boxes(places: list[dict[str, Any]] | None) -> list[dict[str, Any]] | None:
    return None if places is None else [{**place, "box": _bounded(place["box"])} for place in places]


def _bounded(parts: list[list[float | None]]) -> list[list[float]]:
    return [[-math.inf if a is None else a, math.inf if b is None else b] for a, b in parts]


def _text(value: Any) -> Any:
    return as_utf8(value) if isinstance(value, str) else value
