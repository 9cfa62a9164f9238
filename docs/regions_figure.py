"""Draws docs/images/regions.svg from the code of README.md: its sets beside one interval per row."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from sklearn.ensemble import HistGradientBoostingRegressor

import conformodal as cm

HERE = Path(__file__).parent
N_SHOWN, N_TRAINING, N_CALIBRATION = 300, 2000, 1000
BLUE = "#56B4E9"


def interval(X: Any, y: Any, X_new: Any) -> tuple[Any, Any]:
    """Conformalized quantile regression (Romano et al. 2019): the ends of one interval per row."""
    fitted = [
        HistGradientBoostingRegressor(loss="quantile", quantile=q, random_state=0).fit(X[:N_TRAINING], y[:N_TRAINING])
        for q in (0.05, 0.95)
    ]
    low, high = (model.predict(X[N_TRAINING:]) for model in fitted)
    score = np.maximum(low - y[N_TRAINING:], y[N_TRAINING:] - high)
    wider = float(cm.conformal_quantile(score, 0.1))
    return fitted[0].predict(X_new) - wider, fitted[1].predict(X_new) + wider


def draw() -> Figure:
    """One interval per row, through the empty middle, and the sets of README's code, with the same test samples."""
    names: dict[str, Any] = {}
    page = (HERE.parent / "README.md").read_text(encoding="utf-8")
    exec(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[0], names)  # noqa: S102 - the page's own code
    reach, angle = names["reach"][-N_SHOWN:], names["angle"][-N_SHOWN:]
    figure = Figure(figsize=(10, 4), layout="constrained")
    one, ours = figure.subplots(1, 2, sharey=True)
    order = np.argsort(reach)
    X, y = names["reach"][: N_TRAINING + N_CALIBRATION, None], names["angle"][: N_TRAINING + N_CALIBRATION]
    low, high = interval(X, y, reach[order, None])
    one.fill_between(reach[order], low, high, color=BLUE, alpha=0.6, lw=0)
    held = (angle[order] >= low) & (angle[order] <= high)
    one.plot(reach[order][held], angle[order][held], ".", ms=4, color="black")
    one.plot(reach[order][~held], angle[order][~held], "x", ms=5, color="#D55E00")
    cm.draw_regions(names["reg"].predict_region(reach[:, None]), angle, reach, ax=ours)
    if ours.get_legend() is not None:
        ours.get_legend().remove()
    for axis, title in ((one, "one interval: through the empty middle"), (ours, "conformodal: here or there")):
        axis.set(xlabel="reach of the arm (m)", ylabel="")
        axis.set_title(title, fontsize=13)
    one.set_ylabel("elbow angle (degrees)")
    return figure


if __name__ == "__main__":
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "conformodal", "font.size": 11}):
        draw().savefig(HERE / "images" / "regions.svg", metadata={"Date": None})
