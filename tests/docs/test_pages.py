"""Facts about the pages: files that they name, where numbers come from, what ROS users read."""

import re
import runpy
import subprocess
from dataclasses import fields
from pathlib import Path

import pytest

from conformodal.ros.conversion import IMAGE, LIVE, NAMESPACE, TOPICS, TRUTH
from conformodal.ros.parameters import Parameters

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
TABLE = re.compile(r"benchmarks/results/[\w./-]+\.md")


def text_of(path):
    return path.read_text(encoding="utf-8")


# ---- tables and the numbers that are taken from them


@pytest.mark.parametrize("table", sorted({table for path in PAGES for table in TABLE.findall(text_of(path))}))
def test_cited_tables_are_of_a_clean_committed_revision(table):
    text = text_of(ROOT / table)
    assert "-dirty" not in text
    revisions = re.findall(r"source ([0-9a-f]{7,40})", text)
    assert revisions

    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)

    if git("rev-parse", "--is-shallow-repository").stdout.strip() != "false":
        pytest.skip("no history here")
    assert not [r for r in revisions if git("merge-base", "--is-ancestor", r, "HEAD").returncode]


def test_all_tables_are_measured_again_by_one_command():
    units = text_of(ROOT / "benchmarks" / "results.py")
    tables = sorted((ROOT / "benchmarks" / "results").glob("*.md"))
    scripts = {path.name: re.search(r"`python benchmarks/([\w/]+\.py)", text_of(path))[1] for path in tables}
    assert not [name for name, script in scripts.items() if f'Unit("{script}' not in units]


QUOTES = runpy.run_path(str(ROOT / "benchmarks" / "quotes.py"))


@pytest.mark.parametrize("template", QUOTES["templates"](), ids=lambda template: template.name)
def test_pages_that_quote_tables_are_what_their_templates_give(template):
    text, quote = text_of(template), QUOTES["QUOTE"]
    assert not QUOTES["faults"](text)
    assert text_of(QUOTES["page_of"](template)) == QUOTES["written"](template), "run benchmarks/quotes.py --write"
    named = quote.search(text)
    assert QUOTES["faults"](text.replace(named["cells"], "no such cell", 1))
    assert QUOTES["faults"](text.replace(named[0], "0.123", 1))
    assert QUOTES["faults"](text.replace(named[0], named[0].replace("; .", "; "), 1))


def test_a_table_is_as_old_as_its_script_and_what_that_imports():
    bench = ROOT / "benchmarks"
    names = {path.name for path in QUOTES["imported"](bench / "accept.py")}
    assert {"accept.py", "cameras.py", "unseen.py", "worlds.py", "common.py"} <= names
    assert not names & {"growth.py", "recordings.py"}
    assert bench / "common.py" in QUOTES["imported"](bench / "peers" / "run.py")


# ---- pictures and tables that repeat what the source says


def test_the_picture_has_the_packages_of_the_source():
    packages = runpy.run_path(str(DOCS / "layers.py"))["read_packages"]()
    source = {path.parent.name for path in (ROOT / "src" / "conformodal").glob("*/__init__.py")}
    assert sorted(package.name for package in packages) == sorted(source)
    picture = text_of(DOCS / "images" / "layers.svg")
    assert not [name for name in source if f">{name}</text>" not in picture]


def rows(first):
    """Cells of the table of docs/robots.md whose first heading it is, without backticks."""
    table = re.search(rf"^\| {first} \|.*\n\|[- |]+\|\n((?:\|.*\n)+)", text_of(DOCS / "robots.md"), re.MULTILINE)
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in table[1].splitlines()]


def test_topics_and_their_types_are_those_that_are_written():
    assert {name: kind for name, kind, _ in rows("topic")} == {**TOPICS, **TRUTH, **IMAGE, **LIVE}
    assert f"`{NAMESPACE}/`" in text_of(DOCS / "robots.md")


def test_parameters_and_their_defaults_are_the_nodes():
    defaults = {name: default for name, default, _ in rows("parameter")}
    assert list(defaults) == [field.name for field in fields(Parameters)]
    for name, value in vars(Parameters()).items():
        assert defaults[name] == ("must be given" if name == "model" else str(value).lower())
