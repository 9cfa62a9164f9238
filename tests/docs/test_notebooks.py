"""The notebooks run, say what the committed outputs say, and draw a picture where one is committed.

``OMP_NUM_THREADS=1 jupyter execute --inplace --NotebookClient.record_timing=False
--NotebookClient.coalesce_streams=True notebooks/*.ipynb`` makes the outputs anew. Numbers may differ a little between
versions.
"""

import json
import re
import runpy
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = runpy.run_path(str(ROOT / "docs" / "notebook_pages.py"))
NOTEBOOKS = PAGES["notebooks"]()
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
MOST_BYTES = 300_000


def read(name):
    return json.loads((PAGES["FOLDER"] / f"{name}.ipynb").read_text(encoding="utf-8"))


def outputs_of(cells):
    return [output for cell in cells for output in cell.get("outputs", ())]


def drawn(outputs):
    return [kind for output in outputs for kind in PAGES["PICTURES"] if kind in output.get("data", {})]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_small_and_was_run_from_top_to_bottom(name):
    assert (PAGES["FOLDER"] / f"{name}.ipynb").stat().st_size < MOST_BYTES
    code = [cell for cell in read(name)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert {output["output_type"] for output in outputs_of(code)} <= {"stream", "display_data", "execute_result"}
    assert {output["name"] for output in outputs_of(code) if "name" in output} == {"stdout"}  # no warning is shown
    for cell in code:
        kinds = [output["output_type"] for output in cell["outputs"]]
        assert ("stream", "stream") not in pairwise(kinds), "not in pieces"


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_page_of_a_notebook_has_its_code_its_words_and_its_pictures(name):
    page = PAGES["notebook_page"](name)
    cells = read(name)["cells"]
    for cell in cells:
        assert "".join(cell["source"]) in page
        assert bool(drawn(cell.get("outputs", ()))) == bool(cell["metadata"].get("alt"))
    for output in outputs_of(cells):
        assert PAGES["said"](output).rstrip() in page
    shown = re.findall(r"^!\[.{20,}\]\((.+)\)$", page, re.MULTILINE)
    pictures = {place: content for place, content in PAGES["pictures"]().items() if f"/{name}-" in place}
    assert [f"notebooks/{place}" for place in shown] == list(pictures)
    assert len(pictures) == len(drawn(outputs_of(cells))) >= 2
    for place, content in pictures.items():
        assert content.startswith(b"\x89PNG" if place.endswith("png") else b"<svg")


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_says_what_is_committed(name, monkeypatch, tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    fresh = nbformat.read(PAGES["FOLDER"] / f"{name}.ipynb", as_version=4)
    before = [cell.get("outputs", ()) for cell in read(name)["cells"]]
    nbclient.NotebookClient(fresh, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    for cell, committed in zip(fresh.cells, before, strict=True):
        found = cell.get("outputs", ())
        assert drawn(found) == drawn(committed)
        check("".join(map(PAGES["said"], found)), "".join(map(PAGES["said"], committed)))


def check(found, committed):
    assert NUMBER.sub("#", found) == NUMBER.sub("#", committed)
    for a, b in zip(NUMBER.findall(found), NUMBER.findall(committed), strict=True):
        assert float(a) == pytest.approx(float(b), rel=0.2, abs=3 if "." not in b else 0.1)
