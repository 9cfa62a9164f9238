"""Draws docs/images/layers.svg: the packages on their layers, and which package imports which.

python docs/layers.py

Layers are those that import-linter holds (pyproject.toml), imports are read from the source.
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
SOURCE = ROOT / "src" / "conformodal"
PICTURE = ROOT / "docs" / "images" / "layers.svg"

BOX, LINE, BAND = "#dbe9f6", "#2166ac", "#f4f4f4"
WIDE, HIGH = 1.8, 0.8  # of a box; packages are 2 and 1 apart


@dataclass(frozen=True)
class Package:
    """A package of the library.

    Attributes
    ----------
    name
        Its folder.
    layer
        1 is the lowest; a package imports from lower layers only.
    files, lines
        Of Python.
    imports
        Names of the packages that it imports from.
    """

    name: str
    layer: int
    files: int
    lines: int
    imports: frozenset[str]


def read_packages() -> list[Package]:
    """All packages, the highest layer first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    layers = [[name.strip().removeprefix("conformodal.") for name in layer.split("|")] for layer in layers]
    names = {name for layer in layers for name in layer}
    return [_read(name, len(layers) - k, names) for k, layer in enumerate(layers) for name in layer]


def _read(name: str, layer: int, names: set[str]) -> Package:
    texts = {path: path.read_text(encoding="utf-8") for path in sorted((SOURCE / name).rglob("*.py"))}
    used = {module for path, text in texts.items() for module in _imported(path, text)}
    lines = sum(len(text.splitlines()) for text in texts.values())
    return Package(name, layer, len(texts), lines, frozenset(used & names - {name}))


def _imported(path: Path, text: str) -> list[str]:
    """First names below conformodal of all modules that a file imports."""
    inside = path.relative_to(SOURCE.parent).parent.parts
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = [*inside[: len(inside) - node.level + 1]] if node.level else []
            module = start + (node.module.split(".") if node.module else [])
            found += [[*module, alias.name] for alias in node.names]
    return [module[1] for module in found if len(module) > 1 and module[0] == SOURCE.name]


def draw(packages: list[Package]) -> Figure:
    """Boxes from the upper left to the lower right; a line leaves each to the right, and an arrow enters from above."""
    n = len(packages)
    figure = Figure(figsize=(11.5, 7.6))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.6, 2 * n - 0.8), ylim=(-n + 0.2, 1.0))
    axes.set_axis_off()
    place = {package.name: (2 * k, -k) for k, package in enumerate(packages)}
    _draw_layers(axes, packages)
    for package in packages:
        _draw_imports(axes, package, place)
        _draw_arrow(axes, package, packages, place)
        _draw_box(axes, package, *place[package.name])
    legend = "A dot: the package at the left end of the line\nimports the package at the arrow's end."
    axes.text(0, -n + 0.75, legend, fontsize=10, color=LINE, va="center")
    return figure


def _draw_layers(axes: Axes, packages: list[Package]) -> None:
    for layer in range(1, packages[0].layer + 1):
        rows = [-k for k, package in enumerate(packages) if package.layer == layer]
        if layer % 2:
            axes.axhspan(min(rows) - 0.5, max(rows) + 0.5, color=BAND, lw=0)
        middle = (min(rows) + max(rows)) / 2
        axes.text(-1.5, middle, f"{layer}", fontsize=11, color="#777777", va="center")
    axes.text(-1.5, 0.75, "layer", fontsize=9, color="#777777", va="center")


def _draw_imports(axes: Axes, package: Package, place: dict[str, tuple[int, int]]) -> None:
    x, y = place[package.name]
    ends = [place[name] for name in sorted(package.imports)]
    if ends:
        axes.plot([x, max(end for end, _ in ends)], [y, y], color=LINE, lw=0.8)
        axes.plot([end for end, _ in ends], [y] * len(ends), "o", ms=5, color=LINE)


def _draw_arrow(axes: Axes, package: Package, packages: list[Package], place: dict[str, tuple[int, int]]) -> None:
    x, y = place[package.name]
    starts = [place[other.name][1] for other in packages if package.name in other.imports]
    if starts:
        style = {"arrowstyle": "-|>", "color": LINE, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x, y + HIGH / 2), (x, max(starts)), arrowprops=style)


def _draw_box(axes: Axes, package: Package, x: float, y: float) -> None:
    corner = (x - WIDE / 2, y - HIGH / 2)
    shape = FancyBboxPatch(corner, WIDE, HIGH, "round,pad=0,rounding_size=0.1", fc=BOX, ec=LINE, lw=1, zorder=3)
    axes.add_patch(shape)
    axes.text(x, y + 0.21, package.name, fontsize=8.3, weight="bold", ha="center", va="center", zorder=4)
    for below, size in ((0.05, f"{package.lines:,} lines"), (0.25, f"{package.files} files")):
        axes.text(x, y - below, size, fontsize=7.5, ha="center", va="center", zorder=4)


if __name__ == "__main__":
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.family": "DejaVu Sans"}):
        draw(read_packages()).savefig(PICTURE, metadata={"Date": None})
