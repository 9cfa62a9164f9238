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


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """The network and the features of the examples' corridor, for all of them."""
    return tmp_path_factory.mktemp("cache")


# all but one render a corridor, and most train in it
RUNS = [pytest.param(name, marks=() if name == "custom_score.py" else pytest.mark.slow) for name in PRINTED]


@pytest.mark.parametrize("name", RUNS)
def test_an_example_runs(name, cache, tmp_path):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CONFORMODAL_CACHE": str(cache)}
    command = [sys.executable, str(FOLDER / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for words in PRINTED[name]:
        assert words in done.stdout
    assert not list(tmp_path.iterdir())  # what it makes for itself goes with it
