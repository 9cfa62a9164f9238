"""A real browser, pages of made-up runs, and what has to hold of every page."""

from pathlib import Path

import numpy as np
import pytest

from conformodal.geometry import Trajectory
from conformodal.localizer.regions import EvidenceType
from conformodal.report.viewer import Thumbnails
from tests.helpers import region_record

CHECKS = (Path(__file__).parent / "checks.js").read_text(encoding="utf-8")


@pytest.fixture
def opened(browser):
    """Opens a page; what went wrong on it, and what it asked the network for, fails the test when it ends."""
    pages, trouble = [], []

    def take(message):
        if message.type == "error":
            trouble.append(message.text)

    def note(request):
        if not request.url.startswith(("file:", "data:")):
            trouble.append(f"asked for {request.url}")

    def open_page(path, motion="reduce", scheme="light", size=(1280, 1000)):
        viewport = {"width": size[0], "height": size[1]}
        page = browser.new_page(reduced_motion=motion, color_scheme=scheme, viewport=viewport)
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on("console", take)
        page.on("request", note)
        page.goto(path.as_uri())
        page.evaluate(CHECKS)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert trouble == []


def made_up_run(n=60, truth=True, whole_line=False):
    """What :func:`make_viewer` shows: a camera on a circle whose region holds a second place on the other side."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 5, n)
    places = np.column_stack((2 * np.cos(angle), 2 * np.sin(angle), 0.1 * angle))
    quats = np.column_stack((np.cos(angle / 2), np.zeros((n, 2)), np.sin(angle / 2)))
    times = 0.1 * np.arange(n)
    pictures, records = Thumbnails(), []
    for i in range(n):
        around = [np.array([[v - 0.1, v + 0.1]]) for v in (*places[i], *quats[i])]
        kind, p = EvidenceType.GLOBAL, 0.5
        if i >= 30:
            around[0] = np.array([[-3, -2.7], [places[i, 0] - 0.1, places[i, 0] + 0.1]])
        if whole_line and i == 5:
            around[1] = np.array([[-np.inf, np.inf]])
        if i == 7:
            around, kind, p = [np.array([[-np.inf, np.inf]])] * 7, EvidenceType.UNKNOWN, 0.003
        records.append(region_record(f"frame-{i:03d}", times[i], around, p, kind))
        pictures.add(f"frame-{i:03d}", rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    trajectories = {
        "smoothed": Trajectory(times, places + 0.01, quats),
        "classical": Trajectory(times, places + 0.3, quats),
    }
    return records, trajectories, Trajectory(times, places, quats) if truth else None, pictures.jpegs


@pytest.fixture(scope="session")
def make_run():
    return made_up_run
