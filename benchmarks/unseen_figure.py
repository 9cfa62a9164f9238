"""The picture of README: p-values and errors of one run, where the camera has been and where it has not.

python benchmarks/unseen_figure.py [--runs FOLDER]

Drawn from the runs that benchmarks/unseen.py keeps (redkitchen, seed 11, `blocks`, first 60 % known).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib as mpl
import numpy as np
from common import ROOT

mpl.use("Agg")
from matplotlib import pyplot as plt

KNOWN, UNSEEN = "known place: the test part", "unseen: the rest of the recording"
BLUE, RED = "#2166ac", "#b2182b"
LEVEL = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=ROOT / "unseen-out")
    run = json.loads((parser.parse_args().runs / "redkitchen-11.json").read_text())["found"]["blocks, stretches, first"]
    mpl.rcParams.update({"svg.hashsalt": "unseen", "svg.fonttype": "none", "font.size": 9})
    figure, (above, below) = plt.subplots(2, 1, figsize=(7.2, 3.8), sharex=True, layout="constrained")
    start = 0
    for name, label in ((KNOWN, "known places, held out"), (UNSEEN, "places never seen")):
        part = run[name]
        at = np.arange(start, start + part["frames"])
        off, flagged = np.array(part["off_m"]), np.array(part["flagged"])
        p = np.array(part["known_p"])
        for axis, values in ((above, p), (below, off)):
            axis.plot(at[~flagged], values[~flagged], ".", ms=3, color=BLUE)
            axis.plot(at[flagged], values[flagged], ".", ms=3, color=RED)
            if start:
                axis.axvline(start - 0.5, color="black", lw=0.8)
        above.text(at.mean(), 1.25, label, ha="center", va="bottom")
        start = at[-1] + 1
    for level, style in ((LEVEL, "--"), (LEVEL / 2, ":")):
        above.axhline(level, color=RED, lw=0.8, ls=style)
    told = "at or below the line (dotted: where a place is recognised)\nthe region is unbounded"
    above.text(2, 0.019, told, color=RED, va="bottom", fontsize=8)
    above.set(yscale="log", ylim=(0.017, 1.2), ylabel="p-value: known?")
    below.set(yscale="log", ylabel="error (m)", xlabel="answered frame", xlim=(0, start))
    below.plot([], [], ".", color=BLUE, label="reliable")
    below.plot([], [], ".", color=RED, label="flagged: like no place that is known")
    below.legend(loc="lower right", frameon=False, ncols=2)
    figure.savefig(ROOT / "docs" / "images" / "unseen.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
