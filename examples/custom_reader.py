"""A data set in a layout of one's own: a CSV file of names, times and poses beside a folder of images.

python examples/custom_reader.py
"""

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from conformodal.corridor.render import CAMERA
from conformodal.corridor.writer import write_corridor
from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import Recording, read_sevenscenes


def read_csv_layout(file: Path, camera: PinholeCamera) -> Recording:
    """Columns: image, time_s, x, y, z, qw, qx, qy, qz; poses are camera to world."""
    with file.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.reader(lines))[1:]
    numbers = np.array([[float(v) for v in row[1:]] for row in rows])
    times = numbers[:, 0]
    return Recording(
        name=file.stem,
        image_paths=tuple(file.parent / row[0] for row in rows),
        timestamps_s=times,
        recording=np.zeros(len(rows), dtype=np.int64),
        camera=camera,
        truth=Trajectory(times, numbers[:, 1:4], numbers[:, 4:]),
    )


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        world = read_sevenscenes(write_corridor(Path(folder), n_modules=2, n_laps=1, seed=0))
        truth, file = world.require_truth(), Path(folder) / "poses.csv"
        with file.open("w", newline="", encoding="utf-8") as lines:
            writer = csv.writer(lines)
            writer.writerow(["image", "time_s", "x", "y", "z", "qw", "qx", "qy", "qz"])
            for i, path in enumerate(world.image_paths):
                pose = [*truth.positions_xyz[i], *truth.orientations_quat_wxyz[i]]
                writer.writerow([path.relative_to(folder), world.timestamps_s[i], *pose])
        sequence = read_csv_layout(file, CAMERA)
        print(f"{sequence.name}: {len(sequence)} frames of {sequence.image(0).shape[1]}x{sequence.image(0).shape[0]}")
