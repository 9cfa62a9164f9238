import shutil
from collections.abc import Iterator

import numpy as np
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


@pytest.fixture(scope="module")
def short_fits() -> Iterator[None]:
    """Densities with names learn in a tenth of the time, and less well: for tests of what goes in and comes out.

    They have few trees and no smooth member.
    """
    from conformodal.conformal.density import named

    boosting = named.boosting
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(named, "boosting", lambda rate, rounds, *rest: boosting(0.5, 5, *rest))
        patch.setattr(named, "_TREES_AND_FOLDS", ((np.inf, 10, 3),))
        patch.setattr(named, "smooth_member", lambda *_: None)
        yield


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
