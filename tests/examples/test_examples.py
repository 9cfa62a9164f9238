import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples"
PRINTED = {
    "custom_baseline.py": ("ours: ", "forest: "),
    "custom_pose_source.py": ("sources: head, nearest",),
    "custom_reader.py": ("poses: ", "frames of"),
    "custom_reasoner.py": ("nearest: ", "hindsight: "),
    "custom_score.py": ("covered: ", "intervals: "),
    "images.py": (": its region has ", "covered: ", "path: "),
    "stream.py": ("frame-000011.color.png: x ", "region in x: "),
}


def test_every_example_is_run():
    assert {path.name for path in FOLDER.glob("*.py")} == set(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_an_example_runs(name, tmp_path):
    done = run(name, tmp_path)
    assert done.returncode == 0, done.stderr
    for words in PRINTED[name]:
        assert words in done.stdout
    assert not list(tmp_path.iterdir())  # what it makes for itself goes with it


def run(name, folder):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / name)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=folder)
