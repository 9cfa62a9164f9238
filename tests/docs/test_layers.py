"""The picture of the layers shows every package of the source, and no other."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def packages():
    return runpy.run_path(str(ROOT / "docs" / "layers.py"))["read_packages"]()


def test_the_picture_has_the_packages_of_the_source(packages):
    source = {path.parent.name for path in (ROOT / "src" / "conformodal").glob("*/__init__.py")}
    assert len(packages) == len(source)
    assert {package.name for package in packages} == source


def test_packages_import_from_lower_layers_only(packages):
    layer = {package.name: package.layer for package in packages}
    assert all(layer[name] < package.layer for package in packages for name in package.imports)
    assert {package.name for package in packages if not package.imports} == {"core"}


def test_the_committed_picture_names_all_packages(packages):
    picture = (ROOT / "docs" / "images" / "layers.svg").read_text(encoding="utf-8")
    assert not [package.name for package in packages if f">{package.name}</text>" not in picture]
