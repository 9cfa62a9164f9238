import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples"
SAID = {
    "custom_baseline.py": ("ours: ", "forest: "),
    "custom_pose_source.py": ("sources: head, nearest",),
    "custom_reader.py": ("poses: ", "frames of"),
    "custom_reasoner.py": ("nearest: ", "viterbi: "),
    "custom_score.py": ("covered: ", "intervals: "),
}


def test_every_example_is_run():
    assert {path.name for path in FOLDER.glob("*.py")} == set(SAID)


@pytest.mark.parametrize("name", SAID)
def test_an_example_runs_and_fits_on_a_page(name):
    assert len((FOLDER / name).read_text(encoding="utf-8").splitlines()) < 60
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(FOLDER / name)], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    for words in SAID[name]:
        assert words in done.stdout
