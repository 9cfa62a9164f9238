"""A disk that fills up at some point of a command: a plain refusal, and earlier results stay as they were."""

import shutil
import subprocess

import pytest

from conformodal.core import files
from tests.helpers import contents, invoke


@pytest.fixture
def disk(tmp_path):
    """A small file system of its own; only the superuser may mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", place], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as exc:
        pytest.skip(f"tmpfs cannot be mounted here: {exc}")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


def leave(place, kilobytes):
    """Fill a file system up, but for some kilobytes."""
    free = shutil.disk_usage(place).free - 1024 * kilobytes
    (place / "ballast").write_bytes(bytes(max(free, 0)))


@pytest.fixture(scope="module")
def results(small_world, tmp_path_factory):
    out = tmp_path_factory.mktemp("full") / "out"
    arguments = ["run", small_world.model, small_world.folder, "--part", "test", "--out", out]
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    return out


ROWS = [
    ("run", 64, True),
    ("run", 32, False),
    ("run", 200, False),
    ("train", 64, True),
    ("data convert", 64, True),
    ("data convert", 1500, True),
]


@pytest.mark.parametrize(("verb", "kilobytes", "looked"), ROWS)
def test_a_disk_that_fills_up_is_refused_and_earlier_results_stay(
    small_world, results, disk, monkeypatch, verb, kilobytes, looked
):
    if not looked:  # beforehand, so that the disk fills up in the middle of the work
        monkeypatch.setattr(files, "_PROBE_BYTES", 1)
    out = disk / "out"
    arguments = {
        "run": ["run", small_world.model, small_world.folder, "--part", "test", "--out", out],
        "train": ["train", small_world.folder, "--out", out, "--cache", small_world.cache, "--epochs", 2],
        "data convert": ["data", "convert", small_world.folder, "--to", "tum", "--out", out],
    }[verb]
    if verb == "run":
        shutil.copytree(results, out)
    before = contents(disk)
    leave(disk, kilobytes)
    result = invoke(*arguments)
    (disk / "ballast").unlink()
    assert "Traceback" not in result.output
    assert result.exit_code in (2, 4), result.output
    assert "No space left on device" in result.output or "disk is full" in result.output
    left = contents(disk)
    assert {k: left[k] for k in before} == before
