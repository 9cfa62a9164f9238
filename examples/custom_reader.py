"""A data set in a layout of one's own: a CSV file of names, times and poses beside a folder of images.

An installed package adds the layout to all commands by an entry point:

    [project.entry-points."conformodal.layouts"]
    csv = "my_package:CSV"

python examples/custom_reader.py
"""

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from conformodal.corridor import write_corridor
from conformodal.corridor.render import CAMERA
from conformodal.io import FrameTable, Reader, read_recording


def read_csv(folder: Path) -> FrameTable:
    """Columns: image, time_s, x, y, z, qw, qx, qy, qz; poses are camera to world."""
    with (folder / "frames.csv").open(newline="", encoding="utf-8") as lines:
        rows = list(csv.reader(lines))[1:]
    numbers = np.array([[float(v) for v in row[1:]] for row in rows])
    images = [folder / row[0] for row in rows]
    return FrameTable(folder.name, images, times=numbers[:, 0], camera=CAMERA, poses=numbers[:, 1:], root=folder)


CSV = Reader(read_csv, lambda folder: (folder / "frames.csv").is_file(), sign="frames.csv")


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        folder = Path(name)
        world = read_recording(write_corridor(folder, n_modules=2, n_laps=1, seed=0))
        truth = world.require_truth()
        with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as lines:
            writer = csv.writer(lines)
            writer.writerow(["image", "time_s", "x", "y", "z", "qw", "qx", "qy", "qz"])
            for i, path in enumerate(world.image_paths):
                pose = [*truth.positions_xyz[i], *truth.orientations_quat_wxyz[i]]
                writer.writerow([path.relative_to(folder), world.timestamps_s[i], *pose])
        recording = CSV.read(folder).to_recording()
        size = recording.image(0).shape
        print(f"{len(recording.require_truth())} poses: {len(recording)} frames of {size[1]}x{size[0]}")
