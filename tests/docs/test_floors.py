"""The picture of the floors shows every package of the source, and no other."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rooms():
    return runpy.run_path(str(ROOT / "docs" / "floors.py"))["read_rooms"]()


def test_the_rooms_are_the_packages_of_the_source(rooms):
    packages = {path.parent.name for path in (ROOT / "src" / "conformodal").glob("*/__init__.py")}
    assert len(rooms) == len(packages)
    assert {room.name for room in rooms} == packages


def test_rooms_import_from_lower_floors_only(rooms):
    floor = {room.name: room.floor for room in rooms}
    assert all(floor[name] < room.floor for room in rooms for name in room.imports)
    assert {room.name for room in rooms if not room.imports} == {"core"}


def test_the_committed_picture_names_all_rooms(rooms):
    picture = (ROOT / "docs" / "images" / "floors.svg").read_text(encoding="utf-8")
    assert not [room.name for room in rooms if f">{room.name}</text>" not in picture]
