"""Facts about the pages: what a decision rests on."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
DECISIONS = sorted(path for path in (DOCS / "decisions").glob("*.md") if path.name != "README.md")
TABLE = re.compile(r"benchmarks/results/[\w./-]+\.md")


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
