"""Many methods under many conditions, side by side: a figure, and a page for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from conformodal.experiments.table1 import Table

from .figures import COLOURS, as_label, as_svg
from .templating import render_page

# The colours of Okabe and Ito, with a shape each: a reader needs one of the two only.
_MARKS = (
    (COLOURS["smoothed"], "o"),
    ("#332288", "p"),
    (COLOURS["region"], "v"),
    (COLOURS["alike"], "^"),
    ("#E69F00", "<"),
    (COLOURS["classical"], "s"),
    ("#CC79A7", "D"),
    ("#AA4499", "d"),
    ("#117733", "H"),
    ("#000000", "x"),
    ("#666666", "+"),
    ("#999999", "*"),
    ("#8C6D31", "P"),
    ("#5254A3", "X"),
    ("#7A1F5C", "h"),
    ("#44AA99", ">"),
    ("#882255", "8"),
    ("#DDAA33", "h"),
    ("#BB5566", "1"),
    ("#004488", "2"),
    ("#66CCEE", "3"),
)


@dataclass(frozen=True)
class Section:
    """A heading, a figure and the tables below it, each with a name."""

    heading: str
    caption: str
    svg: str
    tables: Sequence[tuple[str, Table]]


def error_chart(conditions: Sequence[str], errors: Mapping[str, Sequence[Sequence[float]]], unit: str) -> str:
    """SVG of errors on a log scale, one line a condition and one mark a method.

    Parameters
    ----------
    conditions
        Names, top to bottom.
    errors
        By method: for every condition the errors of all repeats. Marks are at their means, whiskers reach from the
        smallest to the largest.
    unit
        Of the errors.
    """
    figure = Figure(figsize=(10, 1.4 + 0.62 * len(conditions)), layout="constrained")
    axis = figure.subplots()
    place = np.arange(len(conditions))[::-1]
    offsets = np.linspace(0.32, -0.32, max(len(errors), 2))
    for (name, found), offset, (colour, mark) in zip(errors.items(), offsets, cycle(_MARKS)):
        mean = np.array([np.mean(v) for v in found])
        reach = np.abs(np.array([[np.min(v), np.max(v)] for v in found]).T - mean)
        axis.errorbar(mean, place + offset, xerr=reach, fmt=mark, ms=5, color=colour, lw=0.8, label=as_label(name))
    axis.set_xscale("log")
    axis.set_yticks(place, [as_label(name) for name in conditions])
    axis.set_xlabel(f"position RMSE ({unit})")
    axis.grid(axis="x", which="both", lw=0.3)
    for line in place[:-1]:
        axis.axhline(line - 0.5, color="#bbbbbb", lw=0.5)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return as_svg(figure)


def write_comparison(
    path: Path, title: str, summary: Sequence[str], sections: Sequence[Section], record: Mapping[str, Any]
) -> None:
    """Write the page; `record` says what made it."""
    render_page(path, "comparison", title=title, summary=summary, sections=sections, record=record)
