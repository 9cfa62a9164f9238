import shutil

import pytest

from conformodal.datasets import read_sevenscenes


@pytest.fixture(scope="module")
def sequence(small_world):
    return read_sevenscenes(small_world.folder)


@pytest.fixture
def two_recordings(small_world, tmp_path):
    """The small world's recording twice, as one data set."""
    for name in ("seq-01", "seq-02"):
        shutil.copytree(small_world.folder / "seq-01", tmp_path / name)
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(small_world.folder / name, tmp_path / name)
    return read_sevenscenes(tmp_path)
