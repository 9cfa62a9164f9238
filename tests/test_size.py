"""The source keeps to a budget of lines per package. Raising one needs a reason in the commit message."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "conformodal"
BUDGET = {
    "cli": 3020,
    "conformal": 5940,
    "core": 460,
    "datasets": 6060,
    "localization": 3240,
    "model": 1430,
    "motion": 1040,
    "networks": 720,
    "poses": 1130,
    "quality": 790,
    "reasoning": 1460,
    "report": 860,
    "ros": 710,
    "running": 2130,
    "training": 1100,
    "vision": 480,
}


def lines_of(folder):
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def test_every_package_has_a_budget():
    assert {path.name for path in SOURCE.iterdir() if (path / "__init__.py").is_file()} == BUDGET.keys()


@pytest.mark.parametrize("package", BUDGET)
def test_a_package_keeps_to_its_budget(package):
    assert lines_of(SOURCE / package) <= BUDGET[package]


def test_experiments_and_benchmarks_keep_to_their_budget():
    assert sum(lines_of(ROOT / folder) for folder in ("experiments", "benchmarks")) <= 7630


def test_tests_keep_to_their_budget():
    assert lines_of(ROOT / "tests") + lines_of(ROOT / "experiments" / "tests") <= 22060
