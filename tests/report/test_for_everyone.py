"""Pages can be read at any width, in light and dark, by keyboard alone, and by a screen reader."""

import json

import numpy as np
import pytest

from conformodal.report.page import write_page
from conformodal.report.viewer import Surroundings, make_viewer

pytestmark = pytest.mark.slow

ROW = {"rmse_m": 0.1234, "rmse_deg": 1.5, "median_m": 0.1, "median_deg": 1.2}
TARGET = {"coverage": 0.9, "band_99": [0.8, 0.95], "inside_band": True, "bounded_coverage": None}
TARGET |= {"mean_length": None, "mean_intervals": 1.2}
METRICS = {
    "provenance": {"packages": {"numpy": "2"}, "source_revision": "0" * 40},
    "configuration": {"data": "/a/folder/with-a-name-that-is-so-long-that-it-has-to-be-broken-somewhere/in/the/middle"},
    "n_answered": 60,
    "split_note": "all frames.",
    "journal": [
        {
            "name": "tuesday",
            "date": "2026-01-02",
            "n_frames": 50,
            "coverage": 0.94,
            "bounded": 0.9,
            "reliable": 0.88,
            "median_m": 0.012,
        }
    ],
    "errors": {"smoothed": ROW, "classical": ROW},
    "coverage": {
        "unbounded": True,
        "targets": dict.fromkeys(("x", "y", "z", "q_w"), TARGET),
        **{"joint_coverage": 0.9, "n_evaluated": 100, "n_bounded": 99, "bounded_coverage": 0.9, "abstained": 0.01},
        **{"joint_band_99": [0.85, 0.95], "regions_from": "head", "alpha": 0.1, "joint": "max", "score": "hpd"},
        **{"alpha_per_target": 0.1, "n_calibration": 100},
        "assumption": "Frames are exchangeable.",
    },
}
KINDS = ["run", "bare"]


def run_page(folder, make_run, n=60, **options):
    viewer = make_viewer(*make_run(n, **options), 0.01, Surroundings([np.array([[-2.0, -2.0], [2.0, -2.0]])]))
    write_page(folder / "report.html", "a run", ["60 frames.", "more"], METRICS, viewer)
    return folder / "report.html"


@pytest.fixture(scope="module")
def pages(make_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    bare = {"provenance": {}, "configuration": {}, "n_answered": 1, "split_note": "all frames."}
    viewer = make_viewer(*make_run(1, truth=False)[:2])
    write_page(folder / "bare" / "report.html", "one frame", ["1 frame."], bare, viewer=viewer)
    run = run_page(folder / "run", make_run)
    return {"run": run, "bare": folder / "bare" / "report.html"}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (320, "light")])
def test_everything_stands_out_has_a_name_and_fits_the_window(opened, pages, kind, width, scheme):
    page = opened(pages[kind], scheme=scheme, size=(width, 800))
    for detail in page.locator("summary").all():
        detail.click()
    for check in ("contrast", "labels", "structure", "small", "overflow"):
        assert page.evaluate(f"checks.{check}()") == [], check
    marks = ["--region-line", "--answer", "--classical", "--cursor", "--edge", "--focus"]
    assert page.evaluate("(marks) => checks.palette(['--ink', '--faint'], marks)", marks) == []


@pytest.mark.parametrize("kind", KINDS)
def test_keyboard_focus_is_ordered_and_visible(opened, pages, kind):
    page = opened(pages[kind])
    n, reached = page.evaluate("checks.focusable()"), []
    for _ in range(n):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("checks.focus()"))
    assert [at for at, _, _ in reached] == list(range(n))
    assert [what for _, seen, what in reached if not seen] == []


def where(page):
    return int(page.input_value("#scrub"))


def test_the_keyboard_plays_and_steps(opened, pages):
    page = opened(pages["run"])
    steps = [("End", 59), ("ArrowLeft", 58), ("Home", 0), ("ArrowRight", 1), ("ArrowRight", 2)]
    for target in ("body", "#scrub", "#back", "#turning"):
        if target != "body":
            page.focus(target)
        for key, expected in steps:
            page.keyboard.press(key)
            assert where(page) == expected, (target, key)
    page.focus("#scrub")
    page.keyboard.press(" ")
    assert page.inner_text("#play") == "Pause"
    page.wait_for_function("Number(document.getElementById('scrub').value) > 2")
    page.keyboard.press(" ")
    assert page.inner_text("#play") == "Play"
    page.focus("#play")  # on a button, space presses the button, once
    page.keyboard.press(" ")
    assert page.inner_text("#play") == "Pause"
    page.keyboard.press("Enter")
    assert page.inner_text("#play") == "Play"
    page.focus("#turning")
    view = page.evaluate("document.getElementById('space').toDataURL()")
    page.keyboard.press("A")
    assert page.evaluate("document.getElementById('space').toDataURL()") != view


def test_it_plays_once_when_opened_and_stops_at_the_end(opened, make_run, tmp_path):
    path = run_page(tmp_path, make_run, n=9)
    page = opened(path, motion="no-preference")
    assert page.inner_text("#play") == "Pause"
    page.wait_for_function("document.getElementById('scrub').value === '8'", timeout=10_000)
    page.wait_for_function("document.getElementById('play').textContent === 'Play'")
    page.wait_for_timeout(500)
    assert where(page) == 8
    page.click("#play")  # from the beginning again
    page.wait_for_function("['1', '2', '3'].includes(document.getElementById('scrub').value)", timeout=10_000)
    page.fill("#scrub", "6")  # who takes the slider has it
    page.wait_for_timeout(500)
    assert (where(page), page.inner_text("#play")) == (6, "Play")


def test_sentences_follow_the_frame(opened, pages):
    page = opened(pages["run"])
    frames = json.loads(page.text_content("#viewer-data"))["frames"]
    for i in (0, 7, 40):
        page.fill("#scrub", str(i))
        assert page.inner_text("#seen").endswith(frames[i]["say"])
        assert frames[i]["say"] in page.get_attribute("#plan", "aria-label")
        page.wait_for_function(
            "(say) => document.getElementById('heard').textContent.includes(say)", arg=frames[i]["say"]
        )
    assert page.get_attribute("#heard", "aria-live") == "polite"
