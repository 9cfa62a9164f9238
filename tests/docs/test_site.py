"""The site is built without a warning, its links lead to pages and places, and people can read it and use keys."""

import ast
import os
import re
import runpy
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("mkdocs")
pytest.importorskip("material")
pytest.importorskip("mkdocstrings_handlers.python")

ROOT = Path(__file__).parents[2]
LOOKED_AT = ("index", "examples", "gallery", "robots", "notebooks/table", "reference/conformal")
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


def test_references_of_docstrings_are_resolved(site):
    for page in (site / "reference").glob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert "autoref " not in html
        assert not re.search(r":(?:class|func|meth|attr|data|mod|exc):", html)


def defined(folder):
    """Names of classes and functions in the files of a package, and below it."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in folder.rglob("*.py")]
    return {node.name for tree in trees for node in tree.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}


@pytest.mark.parametrize("package", HOOKS["packages"]())
def test_every_public_class_and_function_is_in_the_reference(site, package):
    html = (site / "reference" / f"{package}.html").read_text(encoding="utf-8")
    places = {name.rpartition(".")[2] for name in re.findall(r'\bid="?(conformodal[\w.]+)', html)}
    folder = ROOT / "src" / "conformodal" / package
    names = {name for path in folder.rglob("__init__.py") for name in HOOKS["exported"](path.parent)}
    assert names & defined(folder) <= places


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", LOOKED_AT)
def test_texts_stand_out_and_pictures_have_words(site, browser, scheme, name):
    page = browser.new_page(viewport={"width": 1300, "height": 900}, color_scheme=scheme)
    page.goto((site / f"{name}.html").as_uri())
    page.wait_for_function("document.body.hasAttribute('data-md-color-media')")
    page.wait_for_timeout(300)  # colours fade into one another
    used = page.evaluate("document.body.getAttribute('data-md-color-scheme')")
    assert used == {"light": "default", "dark": "slate"}[scheme]
    n_texts, faint = page.evaluate((Path(__file__).parent / "contrast.js").read_text(encoding="utf-8"))
    assert n_texts > 20
    assert not faint
    assert page.evaluate("[...document.images].filter((image) => !image.alt).map((image) => image.src)") == []
    page.close()


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_runs_out_of_the_page(site, browser, width):
    page = browser.new_page(viewport={"width": width, "height": 900})
    measure = """() => [
        document.scrollingElement.scrollWidth - innerWidth,
        [...document.querySelectorAll("article pre code")].filter((it) => it.scrollWidth > it.clientWidth + 1).length,
    ]"""
    for name in (*LOOKED_AT, "data", "howto/stream", "results"):
        page.goto((site / f"{name}.html").as_uri())
        beyond, cut = page.evaluate(measure)
        assert beyond <= 0, name
        assert width < 1280 or not cut, f"{name}: {cut} blocks of code have lines that are cut"
    page.close()


def test_search_needs_no_network(site, browser):
    context = browser.new_context(viewport={"width": 1280, "height": 900}, offline=True)
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    page.click(".md-search__input")
    page.keyboard.type("exchangeable")
    page.wait_for_selector(".md-search-result__item a", timeout=20_000)
    context.close()


def test_the_first_key_leads_past_the_navigation(site, browser):
    page = browser.new_page()
    page.goto((site / "start.html").as_uri())
    page.keyboard.press("Tab")
    link = page.evaluate("[document.activeElement.className, document.activeElement.hash.slice(1)]")
    assert "md-skip" in link[0].split()
    assert page.evaluate("(id) => document.getElementById(id).closest('article') !== null", link[1])
    page.close()
