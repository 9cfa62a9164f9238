"""Draws docs/images/regions.svg from the code of README.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

import conformodal as cm

HERE = Path(__file__).parent
N_SHOWN = 300


def draw() -> Figure:
    """Regions and density over the arm's reach, with test samples."""
    names: dict[str, Any] = {}
    page = (HERE.parent / "README.md").read_text(encoding="utf-8")
    exec(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[0], names)  # noqa: S102 - the page's own code
    reach, angle = names["reach"][-N_SHOWN:], names["angle"][-N_SHOWN:]
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    ax = figure.subplots()
    density = names["reg"].predict_density(reach[:, None])
    cm.draw_regions(names["reg"].predict_region(reach[:, None]), angle, reach, density, ax=ax)
    ax.set(xlabel="reach of the arm (m)", ylabel="elbow angle (degrees)")
    ax.legend(frameon=False, loc="upper right", ncols=2)
    return figure


if __name__ == "__main__":
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal"}):
        draw().savefig(HERE / "images" / "regions.svg", metadata={"Date": None})
