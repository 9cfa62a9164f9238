"""The notebooks run, say what the committed outputs say, and draw a picture where one is committed.

``OMP_NUM_THREADS=1 jupyter execute --inplace --NotebookClient.record_timing=False
--NotebookClient.coalesce_streams=True notebooks/*.ipynb`` makes the outputs anew. Numbers may differ a little between
versions.
"""

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = runpy.run_path(str(ROOT / "docs" / "notebook_pages.py"))
NOTEBOOKS = PAGES["notebooks"]()
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def code_cells(name):
    cells = json.loads((PAGES["FOLDER"] / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def drawn(outputs):
    return [kind for output in outputs for kind in PAGES["PICTURES"] if kind in output.get("data", {})]


def text_of(outputs):
    return "".join(map(PAGES["said"], outputs))


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_was_run_from_top_to_bottom_without_a_warning(name):
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"stream", "display_data", "execute_result"}
    assert {output["name"] for output in outputs if "name" in output} == {"stdout"}


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_says_what_is_committed(name, monkeypatch, tmp_path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    fresh = nbformat.read(PAGES["FOLDER"] / f"{name}.ipynb", as_version=4)
    nbclient.NotebookClient(fresh, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    new = [cell["outputs"] for cell in fresh.cells if cell["cell_type"] == "code"]
    for outputs, committed in zip(new, (cell["outputs"] for cell in code_cells(name)), strict=True):
        assert drawn(outputs) == drawn(committed)
        text, expected = text_of(outputs), text_of(committed)
        assert NUMBER.sub("#", text) == NUMBER.sub("#", expected)
        for a, b in zip(NUMBER.findall(text), NUMBER.findall(expected), strict=True):
            assert float(a) == pytest.approx(float(b), rel=0.2, abs=3 if "." not in b else 0.1)
