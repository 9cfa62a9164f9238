"""The picture of README: errors and stated uncertainty in another recording, ours and pycolmap's.

python benchmarks/recordings_figure.py [--runs FOLDER]

Drawn from the frames that benchmarks/recordings.py keeps (fr1_xyz, answered with a map of fr1_desk).
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

SHOWN = (
    ("conformodal", "online", "ours: regions", "#2166ac"),
    ("pycolmap", "refined", "pycolmap: ellipsoids", "#b2182b"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=ROOT / "recordings-out")
    runs = parser.parse_args().runs
    mpl.rcParams.update({"svg.hashsalt": "recordings", "svg.fonttype": "none", "font.size": 9})
    figure, axis = plt.subplots(figsize=(7.2, 3.0), layout="constrained")
    for file, name, label, colour in SHOWN:
        found = json.loads((runs / f"fr1_xyz-{file}.json").read_text())[name]
        off, half = np.array(found["off_m"], float), np.array(found["length_m"], float) / 2
        axis.plot(half, off, ".", ms=4, color=colour, label=label)
    low, high = 3e-4, 1.0
    axis.plot([low, high], [low, high], color="black", lw=0.8)
    axis.text(0.0004, 0.4, "error above the stated one", fontsize=8)
    axis.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    axis.set(xlabel="stated: half the length at 0.9, mean over x, y, z (m)", ylabel="error of the position (m)")
    axis.legend(loc="lower right", frameon=False)
    figure.savefig(ROOT / "docs" / "images" / "recordings.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
