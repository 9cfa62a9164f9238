"""The source keeps to a budget of lines per package. Raising one needs a reason in the commit message."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "conformodal"
BUDGET = {
    "cli": 2830,
    "conformal": 6090,
    "core": 510,
    "datasets": 5050,
    "localization": 2110,
    "model": 1270,
    "motion": 1220,
    "networks": 910,
    "poses": 1130,
    "quality": 1400,
    "reasoning": 1320,
    "report": 1210,
    "ros": 1100,
    "running": 2240,
    "training": 590,
    "vision": 580,
}


def lines_of(folder):
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def test_every_package_has_a_budget():
    assert {path.name for path in SOURCE.iterdir() if (path / "__init__.py").is_file()} == BUDGET.keys()


@pytest.mark.parametrize("package", BUDGET)
def test_a_package_keeps_to_its_budget(package):
    assert lines_of(SOURCE / package) <= BUDGET[package]


def test_experiments_and_benchmarks_keep_to_their_budget():
    assert sum(lines_of(ROOT / folder) for folder in ("experiments", "benchmarks")) <= 6600
