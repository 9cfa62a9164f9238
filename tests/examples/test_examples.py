import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
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
    "table.py": ("elbow: ", " or ", "height: ", "coverage of all targets"),
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


def test_a_table_of_ones_own_is_read_without_text_and_gaps(tmp_path):
    rng = np.random.default_rng(0)
    lines = [f"place{i % 3},{a:.4f},{2 * a:.4f},{-a:.4f}" for i, a in enumerate(rng.random(300))]
    lines[7] = "place1,,1,1"
    (tmp_path / "own.csv").write_text("\n".join(["where,given,up,down side", *lines]) + "\n", encoding="utf-8")
    done = run("table.py", tmp_path, "own.csv", "up", "down side")
    assert done.returncode == 0, done.stderr
    assert "down side: " in done.stdout
    assert "59 test samples" in done.stdout  # a fifth of 299
    said, numbers = next(line for line in done.stdout.splitlines() if ", down side: " in line).split(", down side: ")
    row = lines[int(said.removeprefix("row ").removesuffix(" of the table")) - 1].split(",")
    assert "inputs: given; 1 of 300 rows left out" in done.stdout
    assert float(numbers.split("(true: ")[1].rstrip(")")) == pytest.approx(float(row[3]), rel=1e-3)


@pytest.mark.parametrize("targets", [[], ["upp"], ["where"], ["given", "up"]])
def test_a_table_without_its_targets_is_refused(tmp_path, targets):
    (tmp_path / "own.csv").write_text("given,up,where\n1,2,here\n2,3,there\n", encoding="utf-8-sig")
    done = run("table.py", tmp_path, "own.csv", *targets)
    assert done.returncode == 1
    assert "name targets among its columns of numbers, given, up; got" in done.stderr


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
