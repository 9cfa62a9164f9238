"""Milliseconds per frame, memory and seconds to the first answer: one core and two, 640x480 and 1280x720.

python benchmarks/streaming.py [--frames 300]

Each row is a process of its own, kept to its cores, that knows a saved model and images on disk and nothing else.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
from common import REDKITCHEN, in_process, train_briefly, write_table

from conformodal.io import Recording, read_image, read_sevenscenes

SIZES = {"640x480": (640, 480), "1280x720": (1280, 720)}
SOURCES = (("head", "landmarks"), ("head",))


def enlarged(sequence: Recording, size: tuple[int, int], folder: Path) -> Recording:
    """The recording as a camera with more pixels and a wider image would have taken it."""
    camera, (width, height) = sequence.camera, size
    if (camera.width, camera.height) == size:
        return sequence
    scale = width / camera.width
    top = (round(camera.height * scale) - height) // 2
    (folder / "seq-01").mkdir(parents=True)
    matrix = [[camera.fx * scale, 0, camera.cx * scale], [0, camera.fy * scale, camera.cy * scale - top], [0, 0, 1]]
    np.savetxt(folder / "camera-intrinsics.txt", matrix)
    for path in sequence.image_paths:
        image = cv2.resize(read_image(path), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        cropped = cv2.cvtColor(image[top : top + height], cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "seq-01" / path.name), cropped)
        pose = path.name.replace(".color", ".pose")
        source = path.with_name(pose).with_suffix(".txt")
        (folder / "seq-01" / source.name).write_bytes(source.read_bytes())
    return read_sevenscenes(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    asked = parser.parse_args()
    sequence = read_sevenscenes(REDKITCHEN)
    header = ["image", "pose sources", "cores", "median, ms", "99th percentile, ms", "frames per second"]
    header += ["first answer, s", "resident, MB", "ms per frame, by part"]
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, size in SIZES.items():
            its = enlarged(sequence, size, Path(scratch) / name)
            images = [str(path) for path in its.image_paths[: asked.frames]]
            for sources in SOURCES:
                model = train_briefly(its, Path(scratch) / f"{name}-{len(sources)}", *sources)
                for cores in (1, 2):
                    row = in_process("stream_row.py", [str(model), images], cores)
                    parts = ", ".join(f"{part} {ms:.1f}" for part, ms in row["parts"].items() if ms)
                    times = [f"{row['median']:.1f}", f"{row['p99']:.1f}", f"{1e3 / row['mean']:.1f}"]
                    costs = [f"{row['first_s']:.2f}", f"{row['resident_mb']:.0f}", parts]
                    rows.append([name, ", ".join(sources), str(cores), *times, *costs])
                    print(rows[-1], flush=True)
    note = (
        f"{asked.frames} consecutive frames of redkitchen, 10 of them to warm up, as a camera would give them at 30 "
        "a second; 1280x720: enlarged and cropped. Time of a frame: from decoded image to pose and region; parts are "
        "within it, the rest is fusion, candidates and the novelty test. First answer: from the start of the imports. "
        "The rows of one size are of two models."
    )
    title, command = "A stream on a small computer", "python benchmarks/streaming.py"
    write_table("streaming", title, command, header, rows, note)


if __name__ == "__main__":
    main()
