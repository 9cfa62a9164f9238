"""What is no file is refused wherever a file is expected: a pipe would be waited for, a device read without end."""

import errno
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest

from conformodal import ConformalRegressor
from conformodal.cli.table_csv import read_table
from conformodal.conformal import ConformodalError
from conformodal.core.files import default_cache_dir, usable_cache_dir
from conformodal.io.pose_files import read_tum
from conformodal.io.streams import open_stream
from conformodal.pipeline.results import read_metrics, read_region_records
from conformodal.pipeline.store import load_model
from tests.helpers import LFS_POINTER

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
def test_git_lfs_pointers_are_named_by_all_readers(tmp_path, name):
    (tmp_path / name).write_bytes(LFS_POINTER)
    with pytest.raises(ConformodalError, match=r"is a pointer of Git LFS, not the file; fetch it by 'git lfs pull'"):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize("name", ["truth.tum", "flight.bag", "flight.avi", "model"])
@pytest.mark.parametrize("kind", ["zip", "gztar"])
def test_an_archive_is_to_be_unpacked(tmp_path, name, kind):
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "a").write_text("1")
    made = shutil.make_archive(str(tmp_path / "packed"), kind, tmp_path / "inside")
    shutil.move(made, tmp_path / name)
    with pytest.raises(ConformodalError, match=rf"{name}: is an archive \((zip|gzip)\); unpack it"):
        (load_model if name == "model" else READERS[name])(tmp_path / name)


@pytest.mark.parametrize(("home", "known"), [("/dev/null/nobody", True), (None, False)])
def test_a_user_without_a_home_has_a_temporary_cache(tmp_path, monkeypatch, home, known):
    for name in ("CONFORMODAL_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", home or "")
    monkeypatch.setattr(os.path, "expanduser", lambda path: home if known else path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    usual = default_cache_dir()
    assert usual.is_absolute()
    if not known:
        monkeypatch.setattr(Path, "mkdir", refuse)  # root may write anywhere
    folder = usable_cache_dir()
    monkeypatch.undo()
    assert folder.parent == tmp_path
    (folder / "file").write_text("can be written")


def refuse(*args, **kwargs):
    raise PermissionError(errno.EACCES, "Permission denied")


def test_a_cache_that_was_named_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("1")
    monkeypatch.setenv("CONFORMODAL_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(OSError, match="Not a directory"):
        usable_cache_dir()
    monkeypatch.setenv("CONFORMODAL_CACHE", str(tmp_path / "cache"))
    assert usable_cache_dir() == tmp_path / "cache"


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
def test_what_is_no_file_is_refused_in_one_line(tmp_path, name, make):
    make(tmp_path / name)
    signal.alarm(60)  # ends a test that waits; importing a reader may take ten seconds on a busy machine
    try:
        with pytest.raises(ConformodalError, match=r"^[^\n]*(regular file|no such|no saved model)[^\n]*$"):
            READERS[name](tmp_path / name)
    finally:
        signal.alarm(0)
