"""Names are text and nothing else: on the terminal, in JSON, in tables and on pages."""

import io
import json
import re
import time

import numpy as np
import pytest

from conformodal.cli.console import PlainConsole, plain, progress_bars
from conformodal.core.files import write_whole
from conformodal.geometry import Trajectory
from conformodal.pipeline.results.parquet import write_region_parquet
from conformodal.pipeline.results.records import read_region_records, region_record
from conformodal.pipeline.results.writer import ResultsWriter
from conformodal.report.page import ReportContent, write_page
from conformodal.report.viewer import make_viewer
from tests.helpers import invoke

NAMES = {
    "markup": "x[final]", "closing markup": "x[/y]", "style": "[bold red]x[/bold red]",
    "link": "[link=http://a]x[/link]", "emoji": "camera:x:", "backslash": "a\\[b]\\", "script": "<!--<script>.png",
    "end of script": "</script><script>alert(1)</script>", "html": "<img src=x onerror=alert(1)>",
    "quotes": "a\"b'c`d", "template": "{{ 7*7 }}{% raw %}", "separators": "a\u2028b\u2029c", "newline": "a\nb",
    "tab": "a\tb", "escape": "\x1b[31mred\x1b[0m", "title of the terminal": "\x1b]0;owned\x07", "c1": "a\x9b31mb",
    "bytes": "caf\udce9.png", "right to left": "a\u202egnp.exe", "zero width": "a\u200bb",
    "beyond the plane": "\U0001f600.png", "percent": "%s%n{0}", "long": "x" * 5000, "empty": "",
}  # fmt: skip


@pytest.fixture(params=NAMES)
def name(request):
    return NAMES[request.param]


def shown(*things, **options):
    file = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    PlainConsole(file=file, force_terminal=True, color_system="truecolor", width=9000).print(*things, **options)
    file.flush()
    return file.buffer.getvalue().decode()


def test_the_terminal_shows_names_as_they_are(name):
    said = shown(f"{name}: 7scenes layout", soft_wrap=True)
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


def run_of(name, folder):
    times = np.arange(3.0)
    with ResultsWriter(folder) as writer:
        writer.poses("smoothed", Trajectory(times, np.eye(3), np.tile([1.0, 0, 0, 0], (3, 1))))
        for t in times:
            writer.region(region_record(f"{name}{t:.0f}", t, None, [np.array([[-2.0, 2.0]])] * 7))


def test_frames_of_any_name_are_stored_and_shown(name, tmp_path):
    run_of(name, tmp_path)
    records = read_region_records(tmp_path / "regions.jsonl")
    assert [r["frame"] for r in records] == [f"{name}{i}" for i in range(3)]
    viewer = make_viewer(tmp_path, {f"{name}{i}": b"jpeg" for i in range(3)})
    metrics = {"provenance": {"name": name}, "configuration": {"data": name}, "n_answered": 3, "split_note": name}
    write_page(tmp_path / "report.html", ReportContent(name, [name], metrics, viewer=viewer))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    inside = re.search(r'<script type="application/json" id="viewer-data">(.*?)</script>', page, re.DOTALL).group(1)
    assert [f["n"] for f in json.loads(inside)["frames"]] == [f"{name}{i}" for i in range(3)]
    assert not set("<>&") & set(inside)
    assert page.count("<script") == 2  # ours
    assert page.count("</script") == 2
    for foreign in ("<img src=x", "<script>alert"):
        assert foreign not in page


def test_frames_of_any_name_go_into_parquet(name, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    run_of(name, tmp_path)
    write_region_parquet(tmp_path)
    found = parquet.read_table(tmp_path / "regions.parquet")["frame"].to_pylist()
    assert found == [f"{name}{i}".encode("utf-8", "backslashreplace").decode() for i in range(3)]


def test_text_of_any_kind_can_be_written(name, tmp_path):
    write_whole(tmp_path / "x.md", name)
    assert (tmp_path / "x.md").read_bytes().decode() == name.encode("utf-8", "backslashreplace").decode()


def test_progress_is_written_beside_the_folder_of_results(tmp_path, monkeypatch):
    monkeypatch.setattr("conformodal.cli.console._LOG_EVERY_S", 0.01)
    log = tmp_path / "model.log"
    with progress_bars(tmp_path / "model") as report:
        report("features", 5, 5)
        report("training", 1, 3)
        while not log.exists() or "training 1/3\n" not in log.read_text():
            time.sleep(0.01)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d training 1/3", log.read_text().splitlines()[-1])
    first = log.read_text()
    with progress_bars(tmp_path / "model") as report:
        while log.read_text() == first or "evaluation 0/3\n" not in log.read_text():
            report("evaluation", 0, 3)
            time.sleep(0.01)
    assert "training" not in log.read_text()  # the log of the run before is replaced


@pytest.mark.parametrize("content", [b"", b"2026-01-01 08:00:00 my notes\n"])
def test_a_log_of_another_program_is_left_alone(content, tmp_path, monkeypatch):
    monkeypatch.setattr("conformodal.cli.console._LOG_EVERY_S", 0.01)
    log = tmp_path / "runs.log"
    log.write_bytes(content)
    with progress_bars(tmp_path / "runs") as report:
        report("training", 1, 3)
        time.sleep(0.1)
    assert log.read_bytes() == content
