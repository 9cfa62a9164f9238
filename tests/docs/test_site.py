"""The site is built without a warning, of which a dead link is one, and people can read and search it."""

import importlib
import inspect
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("mkdocs")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings_handlers.python")

ROOT = Path(__file__).parents[2]
LOOKED_AT = ("index", "examples", "gallery", "robots", "notebooks/table", "reference/conformal", "results")
HOOKS = runpy.run_path(str(ROOT / "docs" / "hooks.py"))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


def test_references_of_docstrings_are_resolved(site):
    for page in (site / "reference").glob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert "autoref " not in html
        assert not re.search(r":(?:class|func|meth|attr|data|mod|exc):", html)


@pytest.mark.parametrize("package", HOOKS["packages"]())
def test_every_exported_class_and_function_is_in_the_reference(site, package):
    html = (site / "reference" / f"{package}.html").read_text(encoding="utf-8")
    places = {name.rpartition(".")[2] for name in re.findall(r'\bid="?(conformodal[\w.]+)', html)}
    module = importlib.import_module(f"conformodal.{package}")
    values = {name: getattr(module, name) for name in getattr(module, "__all__", ())}
    assert {name for name, value in values.items() if inspect.isclass(value) or inspect.isfunction(value)} <= places


@pytest.mark.parametrize("name", LOOKED_AT)
def test_pictures_have_words(site, name):
    images = re.findall(r"<img\b[^>]*>", (site / f"{name}.html").read_text(encoding="utf-8"))
    assert not [image for image in images if not re.search(r'\balt="?[^\s">]', image)]


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_runs_out_of_the_page(site, browser, width):
    page = browser.new_page(viewport={"width": width, "height": 900})
    for name in LOOKED_AT:
        page.goto((site / f"{name}.html").as_uri())
        assert page.evaluate("document.scrollingElement.scrollWidth - innerWidth") <= 0, name
    page.close()
