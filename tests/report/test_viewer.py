"""The page, in a real browser."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from conformodal.geometry import Trajectory
from conformodal.localizer.regions import EvidenceType
from conformodal.report.page import write_page
from conformodal.report.viewer import Surroundings, make_viewer
from tests.helpers import region_record

JOURNAL = [
    {"name": "tuesday", "date": "2026-01-02", "n_frames": 50, "coverage": 0.94, "bounded": 0.9, "reliable": 0.88,
     "median_m": 0.012},
    {"name": "<b>wednesday", "date": "2026-01-03", "n_frames": 51, "coverage": 0.7, "bounded": 1.0, "reliable": 0.5,
     "median_m": 0.3},
    {"name": "walk.mp4", "date": "2026-01-04", "n_frames": 52, "coverage": None, "bounded": 0.8, "reliable": 0.6,
     "median_m": None},
]  # fmt: skip
METRICS = {"provenance": {}, "configuration": {}, "n_answered": 60, "split_note": "all frames."}


def page_of(folder, run, title="a run"):
    viewer = make_viewer(*run, surroundings=Surroundings(trained_xyz=np.zeros((3, 3))))
    write_page(folder / "report.html", title, ["first line"], METRICS, viewer=viewer)
    return folder / "report.html"


def ink(page, canvas):
    """How many pixels of a canvas are not empty, and a sum that tells pictures apart."""
    return page.evaluate(
        """(id) => {
            const c = document.getElementById(id), d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
            let used = 0, sum = 0;
            for (let i = 0; i < d.length; i += 4) {
                if (d[i + 3]) used++;
                sum = (sum * 31 + d[i] + d[i + 3]) % 1000003;
            }
            return [used, sum];
        }""",
        canvas,
    )


def test_the_page_shows_the_journal_of_recordings(make_run, tmp_path):
    viewer, metrics = make_viewer(*make_run()), METRICS | {"configuration": {"alpha": 0.2}, "journal": JOURNAL}
    write_page(tmp_path / "report.html", "a run", ["first line"], metrics, viewer=viewer)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    section = text[text.index('id="journal"') : text.index("</section>", text.index('id="journal"'))]
    assert [width for width in ("94.0", "70.0") if f'<rect width="{width}"' in section] == ["94.0", "70.0"]
    assert section.count('d="M80.0 0') == 2  # what is asked for
    assert "&lt;b&gt;wednesday" in section
    assert section.count("no poses: joined the map alone") == 1
    assert section.count("<svg") == 2  # none of it
    assert section.count("reliable frames joined the map at") == 1
    page = page_of(tmp_path, make_run()).read_text(encoding="utf-8")
    assert 'id="journal"' not in page


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_clicking_through_the_page(opened, make_run, tmp_path, scheme):
    path = page_of(tmp_path, make_run())
    page = opened(path, scheme=scheme, size=(1000, 1400))
    canvases = ["plan", "space", "band-x", "band-y", "band-z", "known", "size", "error", "angle"]
    first = {name: ink(page, name) for name in canvases}
    assert all(used > 200 for used, _ in first.values()), first
    assert page.inner_text("#label").startswith("frame-000 (frame 1 of 60, 0.00 s)")
    words = page.inner_text("#words")
    assert "places of the image\n1\n" in words
    assert "0.0173 m" in words  # off by 0.01 along each axis
    source = page.get_attribute("#frame", "src")
    # the slider
    page.fill("#scrub", "40")
    assert page.inner_text("#label").startswith("frame-040 (frame 41 of 60, 4.00 s)")
    assert "places of the image\n2\n" in page.inner_text("#words")
    assert page.get_attribute("#frame", "src") != source
    then = {name: ink(page, name) for name in canvases}
    assert all(then[name] != first[name] for name in canvases)
    # buttons and charts; test_for_everyone.py has the keys and the player
    page.click("#forth")
    assert page.inner_text("#label").startswith("frame-041")
    page.click("#back")
    assert page.inner_text("#label").startswith("frame-040")
    box = page.locator("#error").bounding_box()
    page.locator("#error").click(position={"x": box["width"] - 8, "y": 40})
    assert page.inner_text("#label").startswith("frame-059")
    # the trajectory turns
    before = ink(page, "space")
    box = page.locator("#space").bounding_box()
    page.mouse.move(box["x"] + 50, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 90, steps=4)
    page.mouse.up()
    assert ink(page, "space") != before
    page.screenshot(path=tmp_path / "page.png", full_page=True)
    shade = np.asarray(Image.open(tmp_path / "page.png").convert("L"))[:, :40].mean()
    assert (shade < 80) == (scheme == "dark")


@pytest.mark.slow
def test_a_run_without_truth_images_or_bounds_is_shown_too(opened, make_run, tmp_path):
    page = opened(page_of(tmp_path, make_run(12, truth=False, whole_line=True)[:3]))
    assert page.locator("canvas").count() == 7
    assert page.locator("#frame").count() == 0
    page.fill("#scrub", "5")
    assert page.inner_text("#label").startswith("frame-005")


def test_long_runs_are_thinned_and_stay_small(make_run, tmp_path):
    n = 1200
    run = make_run(n)
    assert len(run[-1]) <= 1000
    path = page_of(tmp_path, run)
    shown = json.loads(re.search(r'id="viewer-data">(.*?)</script>', path.read_text(), re.DOTALL)[1])
    assert 500 <= len(shown["frames"]) <= 1000
    steps = np.diff([frame["t"] for frame in shown["frames"]])
    np.testing.assert_allclose(steps, steps[0], atol=1e-6)  # evenly
    assert (shown["trained"], {"img" in frame for frame in shown["frames"]}) == ([[0, 0, 0]] * 3, {True})
    assert f"{len(shown['frames'])} of {n} frames are shown" in path.read_text()


def test_recordings_are_apart_and_gaps_between_them_closed():
    times = np.concatenate((0.2 * np.arange(5), 86400 + 0.2 * np.arange(4)))
    path = Trajectory(times, np.zeros((9, 3)), np.tile([1.0, 0, 0, 0], (9, 1)))
    records = [
        region_record(f"{i}", t, [np.array([[0.0, 1.0]])] * 7) | {"recording": i // 5} for i, t in enumerate(times)
    ]
    data = make_viewer(records, {"smoothed": path})["data"]
    assert [frame["rec"] for frame in data["frames"]] == [0] * 5 + [1] * 4
    np.testing.assert_allclose([frame["t"] for frame in data["frames"]], 0.2 * np.arange(9))
    assert data["step"] == pytest.approx(0.2)


def test_a_frame_that_shows_no_known_place_has_no_box():
    one = Trajectory(np.array([0.0, 0.1]), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    whole = [np.array([[-np.inf, np.inf]])] * 7
    records = [
        region_record("a", 0.0, [np.array([[0.0, 1.0]])] * 7, 0.43, EvidenceType.LANDMARKS),
        region_record("b", 0.1, whole, 0.003, EvidenceType.UNKNOWN),
    ]
    viewer = make_viewer(records, {"smoothed": one}, level=0.01)
    assert viewer["known"]
    data = viewer["data"]
    assert data["level"] == 0.01
    known, unknown = data["frames"]
    assert (known["kp"], known["ev"], known["whole"], known["ok"]) == (0.43, "landmarks", False, True)
    assert (unknown["kp"], unknown["ev"], unknown["whole"], unknown["ok"]) == (0.003, "unknown", True, False)
    assert unknown["size"] is None
