"""What is no file is refused wherever a file is expected: a pipe would be waited for, a device read without end."""

import os
import signal

import pytest

from conformodal import ConformalRegressor
from conformodal.cli.table_csv import read_table
from conformodal.conformal import ConformodalError
from conformodal.io.pose_files import read_tum
from conformodal.io.streams import open_stream
from conformodal.pipeline.results import read_metrics, read_region_records
from conformodal.pipeline.store import load_model

READERS = {
    "model.json": lambda path: load_model(path.parent),
    "metrics.json": lambda path: read_metrics(path.parent),
    "regions.jsonl": read_region_records,
    "truth.tum": read_tum,
    "flight.bag": open_stream,
    "flight.avi": open_stream,
    "regressor.skops": ConformalRegressor.load,
    "table.csv": read_table,
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
def test_what_is_no_file_is_refused_in_one_line(tmp_path, name, make):
    make(tmp_path / name)
    signal.alarm(10)  # ends a test that waits
    try:
        with pytest.raises(ConformodalError, match=r"^[^\n]*(regular file|no such|no saved model)[^\n]*$"):
            READERS[name](tmp_path / name)
    finally:
        signal.alarm(0)
