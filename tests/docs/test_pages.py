"""Facts about the pages: what a decision rests on, where numbers come from, how long pages are."""

import re
import runpy
import subprocess
from dataclasses import fields
from pathlib import Path

import pytest

from conformodal.ros.conventions import IMAGE, TOPICS, TRUTH, Conventions
from conformodal.ros.node import Parameters

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
DECISIONS = sorted(path for path in (DOCS / "decisions").glob("*.md") if path.name != "README.md")
TABLE = re.compile(r"benchmarks/results/[\w./-]+\.md")
NUMBER = re.compile(r"(?<![\w.,-])\d+(?:\.\d+)?(?![\w.]*\w)")


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def sections_of(markdown):
    """Text of each section by its heading."""
    parts = re.split(r"^## (.+)$", markdown, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


# ---- decisions


def test_decisions_are_few_and_listed():
    listed = re.findall(r"\]\(([\w-]+\.md)\)", (DOCS / "decisions" / "README.md").read_text(encoding="utf-8"))
    assert sorted(listed) == [path.name for path in DECISIONS]
    assert len(DECISIONS) <= 15


@pytest.mark.parametrize("path", DECISIONS, ids=lambda path: path.stem)
def test_a_decision_rests_on_a_table_or_a_test(path):
    sections = sections_of(path.read_text(encoding="utf-8"))
    assert list(sections) == ["Question", "Decision", "Evidence", "Limits"]
    assert TABLE.search(sections["Evidence"]) or "`tests/" in sections["Evidence"]


@pytest.mark.parametrize("path", PAGES, ids=name_of)
def test_files_that_a_page_names_exist(path):
    named = re.findall(r"`((?:tests|benchmarks|examples|notebooks|docs|scripts)/[\w./-]*)`", path.read_text("utf-8"))
    assert not [name for name in named if not (ROOT / name).exists()]


# ---- tables and the numbers that are taken from them


TABLES = sorted({table for path in PAGES for table in TABLE.findall(path.read_text(encoding="utf-8"))})


def in_history(revision):
    done = subprocess.run(
        ["git", "merge-base", "--is-ancestor", revision, "HEAD"], cwd=ROOT, capture_output=True, check=False
    )
    return done.returncode == 0


@pytest.mark.parametrize("table", TABLES)
def test_a_table_that_is_cited_is_of_a_clean_revision_in_the_history(table):
    text = (ROOT / table).read_text(encoding="utf-8")
    assert "-dirty" not in text
    revisions = re.findall(r"source ([0-9a-f]{7,40})", text)
    assert revisions
    command = ["git", "rev-parse", "--is-shallow-repository"]
    shallow = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if shallow.stdout.strip() != "false":
        pytest.skip("no history here")
    assert not [revision for revision in revisions if not in_history(revision)]


def measured(markdown):
    """Numbers with at least two decimals: those that only a measurement gives."""
    prose = re.sub(r"```.*?```|`[^`]*`|\]\([^)]*\)", "", markdown, flags=re.DOTALL)
    return [number for number in NUMBER.findall(prose) if len(number.partition(".")[2]) >= 2]


def stands_in(number, text):
    digits = len(number.partition(".")[2])
    return any(f"{float(found):.{digits}f}" == number for found in NUMBER.findall(text))


CITING = {name_of(path): path.read_text(encoding="utf-8") for path in DECISIONS}
CITING |= {
    f"{name}: {heading}": text
    for name in ("README.md", "docs/results.md")
    for heading, text in sections_of((ROOT / name).read_text(encoding="utf-8")).items()
    if TABLE.search(text)
}


@pytest.mark.parametrize("name", CITING)
def test_measured_numbers_stand_in_a_table_that_is_cited_beside_them(name):
    text = CITING[name]
    tables = "\n".join((ROOT / table).read_text(encoding="utf-8") for table in TABLE.findall(text))
    missing = [number for number in measured(text) if not stands_in(number, tables)]
    constants = {"0.005", "0.015"}  # of methods, not of measurements
    assert not set(missing) - constants


# ---- length


def test_pages_are_short():
    lines = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in PAGES}
    assert lines["README.md"] <= 120
    assert not {name: n for name, n in lines.items() if n > 150}
    words = sum(len(path.read_text(encoding="utf-8").split()) for path in DOCS.rglob("*.md"))
    assert words <= 14_000


def test_the_picture_has_the_packages_of_the_source():
    packages = runpy.run_path(str(ROOT / "docs" / "layers.py"))["read_packages"]()
    source = {path.parent.name for path in (ROOT / "src" / "conformodal").glob("*/__init__.py")}
    assert sorted(package.name for package in packages) == sorted(source)
    picture = (ROOT / "docs" / "images" / "layers.svg").read_text(encoding="utf-8")
    assert not [name for name in source if f">{name}</text>" not in picture]


ROBOTS = (ROOT / "docs" / "robots.md").read_text(encoding="utf-8")


def rows(first):
    """Cells of the table whose first heading it is, without backticks."""
    table = re.search(rf"^\| {first} \|.*\n\|[- |]+\|\n((?:\|.*\n)+)", ROBOTS, re.MULTILINE)
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in table[1].splitlines()]


def test_topics_and_their_types_are_those_that_are_written():
    known = {**TOPICS, **TRUTH, **IMAGE}
    assert {name: kind for name, kind, _ in rows("topic")} == known
    assert f"`{Conventions().namespace}/`" in ROBOTS


def test_parameters_and_their_defaults_are_the_nodes():
    said = {name: default for name, default, _ in rows("parameter")}
    assert list(said) == [field.name for field in fields(Parameters)]
    for name, value in vars(Parameters()).items():
        assert said[name] == ("must be given" if name == "model" else str(value).lower())
