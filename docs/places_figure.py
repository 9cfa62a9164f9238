"""Draws docs/images/places.svg from the demo's answers: the places that an image fits, and the one that motion leaves.

python docs/places_figure.py demo-out
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from conformodal.cli.demo import N_MODULES
from conformodal.corridor.world import CorridorWorld
from conformodal.io import read_image

PICTURE = Path(__file__).parent / "images" / "places.svg"
REGION, PATH, TRUTH, WALL, GREY = "#56B4E9", "#0072B2", "#D55E00", "#404040", "#5A5A5A"
MARGIN_M = 0.12  # around boxes, which are some centimetres wide
APART_M = 1.0  # between places


def chosen_frame(records: list[dict[str, Any]]) -> int:
    """Of the reliable frames whose image names the most places, all apart, and whose path names one: the surest."""

    def worth(record: dict[str, Any]) -> tuple[int, float]:
        places = np.array([place["position_xyz"] for place in record["places"]]).reshape(-1, 3)
        apart = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(places), 1)]
        fits = record["reliable"] and len(record["path_places"]) == 1 and (apart > APART_M).all()
        return len(places) * fits, record["place_p"]

    return max(range(len(records)), key=lambda i: worth(records[i]))


def draw(folder: Path) -> Figure:
    """The image, the plan with its places, and the plan with the place that is left after motion."""
    records = [json.loads(line) for line in (folder / "regions.jsonl").read_text(encoding="utf-8").splitlines()]
    record = records[chosen_frame(records)]
    truth = np.loadtxt(folder / "truth.tum")
    where_xyz = truth[np.argmin(np.abs(truth[:, 0] - record["timestamp_s"])), 1:4]
    world = CorridorWorld(N_MODULES)
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.35))
    seen = figure.add_subplot(grid[:, 0])
    seen.imshow(read_image(next(folder.glob(f"corridor/*/*/{record['frame']}"))))
    seen.set_title("what the camera sees", fontsize=11)
    seen.set_axis_off()
    titles = {"places": "the image alone: {} places", "path_places": "after motion: {} place"}
    for row, (key, title) in enumerate(titles.items()):
        plan = figure.add_subplot(grid[row, 1])
        _draw_plan(plan, world)
        for place in record[key]:
            _draw_place(plan, place, REGION if key == "places" else PATH)
        plan.plot(*where_xyz[:2], marker="+", color=TRUTH, markersize=11, markeredgewidth=2, zorder=4)
        plan.set_title(title.format(len(record[key])), fontsize=11)
    return figure


def _draw_plan(axes: Axes, world: CorridorWorld) -> None:
    for wall in world.plan():
        axes.plot(*wall.T, color=WALL, lw=1, solid_capstyle="round")
    axes.set(aspect="equal")
    axes.set_axis_off()


def _draw_place(axes: Axes, place: dict[str, Any], colour: str) -> None:
    (left, right), (near, far) = place["box"][:2]
    corner, size = (left - MARGIN_M, near - MARGIN_M), (right - left + 2 * MARGIN_M, far - near + 2 * MARGIN_M)
    axes.add_patch(Rectangle(corner, *size, facecolor=colour, alpha=0.8, edgecolor=PATH, zorder=3))
    axes.text(right + 0.25, (near + far) / 2, f"{place['p']:.2f}", color=GREY, fontsize=11, va="center")


def main() -> None:
    """Draw from the folder that the demo wrote."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    mpl.rcParams["svg.hashsalt"] = "places"
    draw(parser.parse_args().folder).savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
