"""The source keeps to a budget of lines per package. Raising one needs a reason in the commit message."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "conformodal"
BUDGET = {
    "cli": 2550,
    "conformal": 5310,
    "core": 430,
    "datasets": 4780,
    "localization": 2100,
    "model": 1250,
    "motion": 990,
    "networks": 810,
    "poses": 930,
    "quality": 1230,
    "reasoning": 1520,
    "report": 1150,
    "ros": 790,
    "running": 2250,
    "training": 580,
    "vision": 470,
}


def lines_of(folder):
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def test_every_package_has_a_budget():
    assert {path.name for path in SOURCE.iterdir() if (path / "__init__.py").is_file()} == BUDGET.keys()


@pytest.mark.parametrize("package", BUDGET)
def test_a_package_keeps_to_its_budget(package):
    assert lines_of(SOURCE / package) <= BUDGET[package]


def test_experiments_and_benchmarks_keep_to_their_budget():
    assert sum(lines_of(ROOT / folder) for folder in ("experiments", "benchmarks")) <= 6620


def test_tests_keep_to_their_budget():
    assert lines_of(ROOT / "tests") + lines_of(ROOT / "experiments" / "tests") <= 17400
