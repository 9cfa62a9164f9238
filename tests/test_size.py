"""The project keeps to a budget of lines and files in all. What a change adds, it takes out elsewhere."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# lines of Python
LINES = {"src": 30_700, "tests": 21_350, "benchmarks": 5_000, "experiments": 2_650, "scripts": 260}
SOURCE_FILES = 260


def python_files(folder):
    return list((ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("folder", LINES)
def test_a_folder_keeps_to_its_budget_of_lines(folder):
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in python_files(folder))
    assert 0 < lines <= LINES[folder]


def test_the_source_keeps_to_its_budget_of_files():
    assert len(python_files("src")) <= SOURCE_FILES
