"""Names are text and nothing else: on the terminal, in JSON, in tables and on pages."""

import json
import re

import numpy as np
import pytest

from conformodal.cli.console import plain, report_line
from conformodal.geometry import Trajectory
from conformodal.pipeline.results import ResultsWriter, read_region_records
from conformodal.report.page import write_page
from conformodal.report.viewer import make_viewer
from tests.helpers import invoke, region_record

NAMES = {
    "markup": "x[final][bold red]x[/bold red]", "link": "[link=http://a]x[/link]", "backslash": "a\\[b]\\:x:",
    "end of script": "</script><script>alert(1)</script>", "html": "<img src=x onerror=alert(1)>",
    "quotes": "a\"b'c`d", "template": "{{ 7*7 }}{% raw %}", "separators": "a\u2028b\u2029c", "newline": "a\nb",
    "escape": "\x1b[31mred\x1b[0m", "bytes": "caf\udce9.png", "right to left": "a\u202egnp.exe",
    "beyond the plane": "\U0001f600.png", "empty": "",
}  # fmt: skip
PATH = Trajectory(np.arange(3.0), np.eye(3), np.tile([1.0, 0, 0, 0], (3, 1)))


@pytest.fixture(params=NAMES)
def name(request):
    return NAMES[request.param]


def test_the_terminal_shows_names_as_they_are(name, capsys):
    report_line(f"{name}: 7scenes layout")
    said = capsys.readouterr().out
    assert said == f"{plain(name)}: 7scenes layout\n"
    assert all(c.isprintable() for c in said.rstrip("\n"))
    if name.isprintable():
        assert name in said


def test_an_error_is_one_line_whatever_it_names(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argument = name.replace("/", "_") or "x"
    result = invoke("train", "--out", "out", "--cache", "c", "--", argument)
    assert result.exit_code in (2, 4), result.output
    assert len(result.stderr.splitlines()) == 1
    assert "Traceback" not in result.output
    assert "\x1b" not in result.output


def test_frames_of_any_name_are_stored_and_shown(name, tmp_path):
    with ResultsWriter(tmp_path) as writer:
        writer.poses("smoothed", PATH)
        for t in range(3):
            writer.region(region_record(f"{name}{t}", float(t), [np.array([[-2.0, 2.0]])] * 7))
    writer.publish({})
    records = read_region_records(tmp_path / "regions.jsonl")
    assert [r["frame"] for r in records] == [f"{name}{i}" for i in range(3)]
    viewer = make_viewer(records, {"smoothed": PATH}, images={f"{name}{i}": b"jpeg" for i in range(3)})
    metrics = {"provenance": {"name": name}, "configuration": {"data": name}, "n_answered": 3, "split_note": name}
    write_page(tmp_path / "report.html", name, [name], metrics, viewer=viewer)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    inside = re.search(r'<script type="application/json" id="viewer-data">(.*?)</script>', page, re.DOTALL).group(1)
    assert [f["n"] for f in json.loads(inside)["frames"]] == [f"{name}{i}" for i in range(3)]
    assert not set("<>&") & set(inside)
    assert page.count("<script") == 2  # ours
    assert page.count("</script") == 2
    for foreign in ("<img src=x", "<script>alert"):
        assert foreign not in page
