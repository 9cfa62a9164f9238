"""The project keeps to a budget of lines and files in all. What a change adds, it takes out elsewhere."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Lines of Python. A budget only ever falls; the goals are 21,000 of source and 14,000 of tests.
LINES = {"src": 23_120, "tests": 14_180, "benchmarks": 2_880, "experiments": 2_680, "scripts": 180}
SOURCE_FILES = 160


def python_files(folder):
    return list((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("folder", LINES)
def test_a_folder_keeps_to_its_budget_of_lines(folder):
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in python_files(folder))
    assert 0 < lines <= LINES[folder]


def test_the_source_keeps_to_its_budget_of_files():
    assert len(python_files("src")) <= SOURCE_FILES
