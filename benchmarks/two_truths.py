"""How far two published references of one recording differ: what an error against one of them can mean.

python benchmarks/two_truths.py
"""

from __future__ import annotations

import csv

import numpy as np
from common import DATA, REDKITCHEN, parser_of, write_table

from conformodal.core.arrays import IntArray
from conformodal.geometry import Trajectory, align, orientation_errors_deg, position_errors_m
from conformodal.io import Recording, read_recording

ALIGNMENTS = ("none", "se3", "sim3")


def colmap_truth(kitchen: Recording) -> tuple[IntArray, Trajectory]:
    """The frames of redkitchen that COLMAP has poses of (Brachmann et al., ICCV 2021), and these, in its own world."""
    with (DATA / "recordings" / "truth" / "sfm" / "redkitchen_seq-01.csv").open(encoding="utf-8") as file:
        rows = {
            row["frame"]: [float(row[k]) for k in ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")]
            for row in csv.DictReader(file)
        }
    names = [path.name.split(".")[0] for path in kitchen.image_paths]
    frames = np.array([i for i, name in enumerate(names) if name in rows])
    poses = np.array([rows[names[i]] for i in frames])
    return frames, Trajectory(kitchen.timestamps_s[frames], poses[:, :3], poses[:, 3:])


def main() -> None:
    parser_of(__doc__).parse_args()
    sequence = read_recording(REDKITCHEN)
    fusion = sequence.require_truth()
    both, colmap = colmap_truth(sequence)
    table = []
    for how in ALIGNMENTS:
        aligned = colmap if how == "none" else align(colmap, fusion[both], how)
        metres, degrees = position_errors_m(aligned, fusion[both]), orientation_errors_deg(aligned, fusion[both])
        numbers = [np.sqrt(np.mean(metres**2)), np.median(metres), np.sqrt(np.mean(degrees**2)), np.median(degrees)]
        table.append([how, *(f"{number:.4f}" for number in numbers[:2]), *(f"{number:.2f}" for number in numbers[2:])])
    write_table(
        "two_truths",
        "Two references of one recording",
        "python benchmarks/two_truths.py",
        ["alignment", "RMSE, m", "median, m", "RMSE, degrees", "median, degrees"],
        table,
        f"7-Scenes redkitchen, sequence 01, {len(both)} frames: poses by KinectFusion, as the data set has them, and "
        "by COLMAP (Brachmann et al., ICCV 2021). An error against one of them that is much smaller is agreement with "
        "that reference, not accuracy.",
    )


if __name__ == "__main__":
    main()
