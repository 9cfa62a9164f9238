"""``conformodal table predict``: regions of the rows of a new file, by a saved regressor."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from joblib import parallel_config

from conformodal.conformal import ConformalRegressor
from conformodal.conformal.tables import input_columns, output_columns
from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.files import check_writable_file, naming_file, remove_leftovers, replacing
from conformodal.core.words import counted, finite_or_none, listed

from .console import Quiet, progress_bars, report_line, warning_lines
from .table_csv import CsvFormat, TableError, date_formats, read_table
from .table_options import DateFormats, DecimalMark, NaValues, Separator, ThousandsMark

_ROWS = 65_536  # at once, and of a row group that is written
_PARQUET, _CSV = ".parquet", ".csv"
_LONGEST = 200  # characters of a note
_ROW_COLUMN = "row"  # the column that numbers the rows


def predict(
    model: Annotated[Path, typer.Argument(help="Regressor that 'table fit --model' has saved.")],
    file: Annotated[Path, typer.Argument(help="CSV or Parquet file with the columns that were learnt from.")],
    out: Annotated[Path, typer.Option(help="File for the regions, .csv or .parquet.")],
    alpha: Annotated[str | None, typer.Option(help="Miscoverage rate; that of the fit by default.")] = None,
    sep: Separator = None,
    decimal: DecimalMark = None,
    thousands: ThousandsMark = None,
    na_values: NaValues = None,
    date: DateFormats = None,
    quiet: Quiet = False,
) -> None:
    """Write the region of every row of a file: intervals with probabilities, their ends, and the mean.

    A CSV file is read as the one learnt from, except for what is named here.
    """
    if out.suffix not in (_PARQUET, _CSV):
        raise TableError(f"{out}: --out must end in {_CSV} or {_PARQUET}")
    with require_extra("table", "conformodal table predict"):
        import_module("pyarrow")
    check_writable_file(out)
    if out.exists() and file.exists() and out.samefile(file):
        raise TableError(f"{out}: is the file to predict, not replaced; name another --out")
    reg = ConformalRegressor.load(model)
    named = named_format(sep, decimal, thousands, na_values, date)
    names, n_rows, chunks = _open(file, reg, as_learnt(reg, named))
    if not n_rows:
        raise TableError(f"{file}: holds no rows")
    with _naming(file):
        needed = input_columns(reg, names)
    copied = [name for name in getattr(reg, "file_format_", {}).get("identifiers", ()) if name in names]
    others = [name for name in names if name not in (*needed, *copied)]
    if copied:
        report_line(f"copied: {listed(copied)}")
    new_names = _renamed(copied, region_columns(reg.bins_.target_names))
    if renamed := [f"{name} to {new}" for name, new in new_names.items() if name != new]:
        report_line(f"note: renamed: {listed(renamed)}, as regions have columns of these names"[:_LONGEST])
    if others:
        report_line(f"note: not read: {listed(others)}, which the model does not know"[:_LONGEST])
    told, done = list[str](), 0
    with (
        progress_bars() as progress,
        warning_lines(UserWarning, told.append),
        _writer(out) as write,
        parallel_config("threading", n_jobs=-1),
    ):
        for table in chunks([*copied, *needed]):
            with _naming(file):
                regions = reg.predict_table(table.select(needed), alpha)
            for name in reversed(copied):
                regions = regions.add_column(0, new_names[name], table[name])
            regions = regions.add_column(0, _ROW_COLUMN, [np.arange(done, done + len(regions))])
            write(regions)
            done += len(regions)
            progress("rows", done, n_rows)
    if told:
        again = f" (and {counted(len(told) - 1, 'warning')} of other rows)" if len(told) > 1 else ""
        report_line(f"note: {told[0]}{again}", bold=True)
    report_line(f"regions of {counted(done, 'row')}: {out.resolve()}")


def named_format(
    sep: str | None,
    decimal: str | None,
    thousands: str | None,
    na_values: Sequence[str] | None,
    date: Sequence[str] | None,
) -> CsvFormat:
    """How a file is written by the options of a command; a shell makes a tab hard to type."""
    sep = "\t" if sep == r"\t" else sep
    return CsvFormat(sep, decimal, thousands, na_values or [], dates=date_formats(date or []))


def region_columns(targets: Sequence[str]) -> list[str]:
    """Names of the columns that are written for these targets; equal ones are refused."""
    return output_columns(targets, [_ROW_COLUMN])


def _renamed(copied: Sequence[str], taken: Sequence[str]) -> dict[str, str]:
    """Names of copied columns, other ones where they are `taken`."""
    names: dict[str, str] = {}
    for name in copied:
        new = name
        while new in taken or (new != name and new in copied):
            new += "_in_file"
        names[name] = new
    return names


def as_learnt(reg: ConformalRegressor, named: CsvFormat, needed: Sequence[str] = ()) -> CsvFormat:
    """How a new file is written: as the one learnt from, except for what is named.

    Columns `needed` beside the inputs are read as they were then; identifiers stay the text that they are.
    """
    how = getattr(reg, "file_format_", {})
    written = dict(how.get("csv", {}))
    written["kinds"] = (
        written.get("kinds", {})  # of which older files have the order of dates, and columns with NA as a label
        | dict.fromkeys(written.pop("day_first", ()), "day first")
        | dict.fromkeys(written.pop("labels", ()), "text with NA")
    )
    written |= {name: value for name, value in vars(named).items() if value}
    written["dates"] = {**how.get("csv", {}).get("dates", {}), **named.dates}
    written["verbatim"] = [name for name in how.get("identifiers", ()) if name not in needed]
    if "units" in how:
        written["units"] = {name: how["units"].get(name, "") for name in [*reg.columns_, *needed]}
    return CsvFormat(**written)


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Name the file in errors about its columns."""
    try:
        yield
    except ConformodalError as exc:
        raise TableError(f"{file}: {exc}") from None


def _open(file: Path, reg: ConformalRegressor, written: CsvFormat) -> tuple[list[str], int, Any]:
    """Names of the columns of a file, its number of rows, and a function of names that gives its tables one by one."""
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import parquet  # noqa: PLC0415

    if file.suffix != _PARQUET:
        frame, notes = read_table(file, written)
        for note in notes:
            report_line(note)
        whole = pa.Table.from_pandas(frame, preserve_index=False)
        starts = range(0, len(frame), _ROWS)
        return list(frame), len(frame), lambda names: (whole.select(names)[at : at + _ROWS] for at in starts)
    try:
        source = parquet.ParquetFile(file, pre_buffer=False)
    except (OSError, pa.ArrowInvalid) as exc:
        raise TableError(f"{file}: cannot be read as Parquet: {' '.join(str(exc).split())}") from None

    def batches(names: list[str]) -> Iterator[Any]:
        for batch in source.iter_batches(_ROWS, columns=names, use_threads=False):
            yield pa.table(batch)

    return source.schema_arrow.names, source.metadata.num_rows, batches


def _finite(value: Any) -> Any:
    """Nested lists and structures with None for infinite numbers, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(one) for one in value]
    return finite_or_none(value) if isinstance(value, float) else value


@contextmanager
def _writer(out: Path) -> Iterator[Any]:
    """A function that writes tables one after another into a file, which is there when all are written."""
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import csv, parquet  # noqa: PLC0415

    def as_text(table: Any) -> Any:
        """Lists, as of intervals and in copied columns, as JSON, in which infinite ends are null."""
        for j, field in enumerate(table.schema):
            if pa.types.is_nested(field.type):
                cells = [
                    None if value is None else json.dumps(_finite(value), default=str) for value in table[j].to_pylist()
                ]
                table = table.set_column(j, field.name, [pa.array(cells, pa.string())])
        return table

    remove_leftovers(out)
    with replacing(out) as part:
        with naming_file(out):
            file = part.open("wb")
        writer: Any = None

        def write(table: Any) -> None:
            nonlocal writer
            table = table if out.suffix == _PARQUET else as_text(table)
            kind = parquet.ParquetWriter if out.suffix == _PARQUET else csv.CSVWriter
            with naming_file(out):
                writer = writer or kind(file, table.schema)
                writer.write_table(table)

        try:
            yield write
        finally:
            with naming_file(out), file:
                if writer is not None:
                    writer.close()
