"""Draws docs/images/tutorial.svg from the code of docs/tutorial.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent


def tutorial_code() -> str:
    """All Python blocks of the page, in order."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (HERE / "tutorial.md").read_text(encoding="utf-8"), re.DOTALL))


def draw(names: dict[str, Any]) -> Figure:
    """Interval and region beside each other, from the names that the page's code leaves behind."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    x = np.linspace(0.4, 1.9, 121)
    center, half = names["forest"].predict(x[:, None]), names["half"]
    left.fill_between(x, center - half, center + half, color="#D55E00", alpha=0.35, lw=0)
    left.plot(x, center, color="#D55E00")
    regions = names["reg"].predict_region(x[:, None])
    step = (x[1] - x[0]) / 2
    for i, at in enumerate(x):
        for low, high in regions.intervals(i)[0]:
            right.fill_between([at - step, at + step], low, high, color="#0072B2", alpha=0.45, lw=0)
    for axis, title in ((left, "interval around a regressor"), (right, "calibrated region")):
        axis.plot(names["X_test"][:300, 0], names["y_test"][:300], ".", ms=3, color="black")
        axis.set_xlabel("reach (m)")
        axis.set_title(f"{title}, alpha = 0.1", fontsize="medium")
    left.set_ylabel("elbow angle (degrees)")
    return figure


if __name__ == "__main__":
    import matplotlib as mpl

    names: dict[str, Any] = {}
    exec(tutorial_code(), names)  # noqa: S102 - the page's own code
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal"}):
        draw(names).savefig(HERE / "images" / "tutorial.svg", metadata={"Date": None})
