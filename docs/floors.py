"""Draws docs/images/floors.svg: the rooms of the package on their floors, and which room imports which.

python docs/floors.py

Floors are those that import-linter holds (pyproject.toml), imports are read from the source.
"""

from __future__ import annotations

import ast
import tomllib
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "conformodal"
PICTURE = ROOT / "docs" / "images" / "floors.svg"

BOX, LINE, BAND = "#dbe9f6", "#2166ac", "#f4f4f4"
WIDE, HIGH = 1.8, 0.8  # of a box; rooms are 2 and 1 apart


@dataclass(frozen=True)
class Room:
    """A package of the library.

    Attributes
    ----------
    name
        Its folder.
    floor
        1 is the lowest; a room imports from lower floors only.
    files, lines
        Of Python.
    imports
        Names of the rooms that it imports from.
    """

    name: str
    floor: int
    files: int
    lines: int
    imports: frozenset[str]


def read_rooms() -> list[Room]:
    """All rooms, the highest floor first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    floors = [[name.strip().removeprefix("conformodal.") for name in layer.split("|")] for layer in layers]
    names = {name for floor in floors for name in floor}
    return [_read(name, len(floors) - k, names) for k, floor in enumerate(floors) for name in floor]


def _read(name: str, floor: int, names: set[str]) -> Room:
    texts = {path: path.read_text(encoding="utf-8") for path in sorted((PACKAGE / name).rglob("*.py"))}
    used = {module for path, text in texts.items() for module in _imported(path, text)}
    lines = sum(len(text.splitlines()) for text in texts.values())
    return Room(name, floor, len(texts), lines, frozenset(used & names - {name}))


def _imported(path: Path, text: str) -> list[str]:
    """First names below conformodal of all modules that a file imports."""
    inside = path.relative_to(PACKAGE.parent).parent.parts
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = [*inside[: len(inside) - node.level + 1]] if node.level else []
            module = start + (node.module.split(".") if node.module else [])
            found += [[*module, alias.name] for alias in node.names]
    return [module[1] for module in found if len(module) > 1 and module[0] == PACKAGE.name]


def draw(rooms: list[Room]) -> Figure:
    """Boxes from the upper left to the lower right; a line leaves each to the right, and an arrow enters from above."""
    n = len(rooms)
    figure = Figure(figsize=(11.5, 7.6))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.6, 2 * n - 0.8), ylim=(-n + 0.2, 1.0))
    axes.set_axis_off()
    place = {room.name: (2 * k, -k) for k, room in enumerate(rooms)}
    _draw_floors(axes, rooms)
    for room in rooms:
        _draw_imports(axes, room, place)
        _draw_arrow(axes, room, rooms, place)
        _draw_box(axes, room, *place[room.name])
    legend = "A dot: the room at the left end of the line\nimports the room at the arrow's end."
    axes.text(0, -n + 0.75, legend, fontsize=10, color=LINE, va="center")
    return figure


def _draw_floors(axes: Axes, rooms: list[Room]) -> None:
    for floor in range(1, rooms[0].floor + 1):
        rows = [-k for k, room in enumerate(rooms) if room.floor == floor]
        if floor % 2:
            axes.axhspan(min(rows) - 0.5, max(rows) + 0.5, color=BAND, lw=0)
        middle = (min(rows) + max(rows)) / 2
        axes.text(-1.5, middle, f"{floor}", fontsize=11, color="#777777", va="center")
    axes.text(-1.5, 0.75, "floor", fontsize=9, color="#777777", va="center")


def _draw_imports(axes: Axes, room: Room, place: dict[str, tuple[int, int]]) -> None:
    x, y = place[room.name]
    ends = [place[name] for name in sorted(room.imports)]
    if ends:
        axes.plot([x, max(end for end, _ in ends)], [y, y], color=LINE, lw=0.8)
        axes.plot([end for end, _ in ends], [y] * len(ends), "o", ms=5, color=LINE)


def _draw_arrow(axes: Axes, room: Room, rooms: list[Room], place: dict[str, tuple[int, int]]) -> None:
    x, y = place[room.name]
    starts = [place[other.name][1] for other in rooms if room.name in other.imports]
    if starts:
        style = {"arrowstyle": "-|>", "color": LINE, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x, y + HIGH / 2), (x, max(starts)), arrowprops=style)


def _draw_box(axes: Axes, room: Room, x: float, y: float) -> None:
    corner = (x - WIDE / 2, y - HIGH / 2)
    shape = FancyBboxPatch(corner, WIDE, HIGH, "round,pad=0,rounding_size=0.1", fc=BOX, ec=LINE, lw=1, zorder=3)
    axes.add_patch(shape)
    axes.text(x, y + 0.21, room.name, fontsize=8.3, weight="bold", ha="center", va="center", zorder=4)
    for below, size in ((0.05, f"{room.lines:,} lines"), (0.25, f"{room.files} files")):
        axes.text(x, y - below, size, fontsize=7.5, ha="center", va="center", zorder=4)


if __name__ == "__main__":
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.family": "DejaVu Sans"}):
        draw(read_rooms()).savefig(PICTURE, metadata={"Date": None})
