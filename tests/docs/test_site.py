"""The site is built without a warning, and its links lead to pages and places on them."""

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

pytest.importorskip("mkdocs")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings_handlers.python")

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.mark.slow
def test_no_link_is_dead(site):
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    places = {path: set(re.findall(r'\b(?:id|name)="?([^"\s>]+)', html)) for path, html in pages.items()}
    dead = []
    for page, html in pages.items():
        if page.name == "404.html":
            continue
        for found in re.findall(r'\b(?:href|src)=(?:"([^"]*)"|([^\s">]+))', html):
            target = unescape(found[0] or found[1])
            if re.match(r"[a-z]+:|//", target):
                continue
            path, _, anchor = unquote(target).partition("#")
            where = (page.parent / path).resolve() if path else page
            where = where / "index.html" if where.is_dir() else where
            if not where.exists() or (anchor and anchor not in places.get(where, {anchor})):
                dead.append(f"{page.relative_to(site)}: {target}")
    assert not dead


@pytest.mark.slow
def test_references_of_docstrings_are_resolved(site):
    for page in (site / "reference").glob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert "autoref " not in html
        assert not re.search(r":(?:class|func|meth|attr|data|mod|exc):", html)


@pytest.mark.slow
def test_every_public_class_is_in_the_reference(site):
    html = (site / "reference" / "conformal.html").read_text(encoding="utf-8")
    for name in ("ConformalRegressor", "SplitConformal", "OnlineConformal", "Regions", "diagnose"):
        assert f'id="conformodal.conformal.{name}"' in html or f"id=conformodal.conformal.{name}" in html
    assert "conformodal.odometry.VisualOdometry" in (site / "reference" / "odometry.html").read_text(encoding="utf-8")
