import shutil

import pytest

from conformodal.io import read_recording

CHROMIUM = next((p for name in ("chromium", "chromium-browser", "google-chrome") if (p := shutil.which(name))), None)


@pytest.fixture(scope="module")
def sequence(small_corridor):
    return read_recording(small_corridor)


@pytest.fixture
def two_recordings(small_corridor, tmp_path):
    """The small world's recording twice, as one data set."""
    for name in ("seq-01", "seq-02"):
        shutil.copytree(small_corridor / "seq-01", tmp_path / name)
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(small_corridor / name, tmp_path / name)
    return read_recording(tmp_path)


@pytest.fixture(scope="session")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with playwright.sync_playwright() as started:
        quiet = ["--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
        opened = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", *quiet])
        yield opened
        opened.close()
