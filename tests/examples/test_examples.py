import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples"
SAID = {
    "custom_baseline.py": ("ours: ", "forest: "),
    "custom_pose_source.py": ("sources: head, nearest",),
    "custom_reader.py": ("poses: ", "frames of"),
    "custom_reasoner.py": ("nearest: ", "hindsight: "),
    "custom_score.py": ("covered: ", "intervals: "),
    "images.py": (": its region has ", "covered: ", "path: "),
    "stream.py": ("frame-000011.color.png: x ", "region in x: "),
}


def test_every_example_is_run():
    assert {path.name for path in FOLDER.glob("*.py")} == set(SAID)


@pytest.mark.parametrize("name", SAID)
def test_an_example_runs_and_fits_on_a_page(name, tmp_path):
    assert len((FOLDER / name).read_text(encoding="utf-8").splitlines()) < 60
    done = run(name, tmp_path)
    assert done.returncode == 0, done.stderr
    for words in SAID[name]:
        assert words in done.stdout
    assert not list(tmp_path.iterdir())  # what it makes for itself goes with it


@pytest.mark.slow
def test_a_stream_is_answered_by_a_saved_model(small_world, tmp_path):
    frames = tmp_path / "flight" / "seq-01"
    frames.mkdir(parents=True)
    for path in sorted(small_world.folder.rglob("frame-00000*")):
        shutil.copy(path, frames)
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(small_world.folder / name, frames.parent)
    done = run("stream.py", tmp_path, str(small_world.model), "flight")
    assert done.returncode == 0, done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [f"frame-00000{i}.color.png" for i in range(10)]
    assert done.stdout.count("region in x: ") == 10


def run(name, folder, *arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=folder)
