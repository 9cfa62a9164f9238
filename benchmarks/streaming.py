"""Milliseconds per frame, memory and seconds to the first answer: one core and two, 640x480 and 1280x720.

python benchmarks/streaming.py

Each row is a process of its own, kept to its cores, that knows a saved model and images on disk and nothing else.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import REDKITCHEN, RUNS, parser_of, write_table

from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.io import Recording, read_image, read_recording
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.store import save_model
from conformodal.pipeline.train import prepare_training_data, train_model

FRAMES = 300
SIZES = {"640x480": (640, 480), "1280x720": (1280, 720)}
EVERY = ("head", "neighbours", "landmarks")
MODES = ((EVERY, "orb"), (EVERY, "xfeat"), (EVERY[:2], "orb"))  # pose sources and local features


def enlarged(sequence: Recording, size: tuple[int, int], folder: Path) -> Recording:
    """The recording as a camera with more pixels and a wider image would have taken it."""
    camera, (width, height) = sequence.camera, size
    if (camera.width, camera.height) == size:
        return sequence
    if (folder / "camera-intrinsics.txt").is_file():
        return read_recording(folder)
    scale = width / camera.width
    top = (round(camera.height * scale) - height) // 2
    (folder / "seq-01").mkdir(parents=True, exist_ok=True)
    matrix = [[camera.fx * scale, 0, camera.cx * scale], [0, camera.fy * scale, camera.cy * scale - top], [0, 0, 1]]
    for path in sequence.image_paths:
        image = cv2.resize(read_image(path), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        cropped = cv2.cvtColor(image[top : top + height], cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "seq-01" / path.name), cropped)
        pose = path.name.replace(".color", ".pose")
        pose_file = path.with_name(pose).with_suffix(".txt")
        (folder / "seq-01" / pose_file.name).write_bytes(pose_file.read_bytes())
    np.savetxt(folder / "camera-intrinsics.txt", matrix)  # the last: then the recording is whole
    return read_recording(folder)


def train_briefly(sequence: Recording, folder: Path, sources: tuple[str, ...], features: str) -> Path:
    """Save a model whose training is short, and keep it: that does not change how fast it is."""
    if (folder / "model.json").is_file():
        return folder
    config = ModelConfig(sources=sources, features=features, training=TrainingConfig(epochs=5))
    save_model(train_model(prepare_training_data(sequence, config, FeatureCache(None)), config), folder)
    return folder


def stream_costs(model: Path, images: list[str], cores: int) -> dict[str, Any]:
    """What a stream costs in a process of its own, kept to some cores."""
    allowed = sorted(os.sched_getaffinity(0))[:cores]
    finished = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("stream_row.py"))],
        input=json.dumps([str(model), images]),
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, allowed),
        env={**os.environ, "OMP_NUM_THREADS": str(cores), "OPENBLAS_NUM_THREADS": str(cores)},
    )
    costs: dict[str, Any] = json.loads(finished.stdout.splitlines()[-1])
    return costs


def main() -> None:
    parser_of(__doc__).parse_args()
    sequence = read_recording(REDKITCHEN)
    header = ["image", "pose sources", "local features", "cores", "median, ms", "99th percentile, ms"]
    header += ["frames per second", "network needed", "first answer, s", "resident, MB", "ms per frame, by part"]
    rows, kept = [], RUNS / "streaming"
    for name, size in SIZES.items():
        recording = enlarged(sequence, size, kept / name)
        images = [str(path) for path in recording.image_paths[:FRAMES]]
        for sources, features in MODES:
            model = train_briefly(recording, kept / f"{name}-{len(sources)}{features}", sources, features)
            for cores in (1, 2):
                costs = stream_costs(model, images, cores)
                parts = ", ".join(f"{part} {ms:.1f}" for part, ms in costs["parts"].items() if ms)
                times = [f"{costs['median']:.1f}", f"{costs['p99']:.1f}", f"{1e3 / costs['mean']:.1f}"]
                others = [f"{costs['first_s']:.2f}", f"{costs['resident_mb']:.0f}", parts]
                mode = [name, ", ".join(sources), features if sources == EVERY else "-", str(cores)]
                rows.append([*mode, *times, f"{costs['network']:.2f}", *others])
                print(rows[-1], flush=True)
    note = (
        f"{FRAMES} consecutive frames of redkitchen, 10 of them to warm up, as a camera would give them at 30 "
        "per second; 1280x720: enlarged and cropped. Time of a frame: from decoded image to pose and region; parts are "
        "within it, the rest is fusion, candidates and the novelty test. The network retrieves landmarks by ORB, so it "
        "counts in both parts; XFeat retrieves its own, and the network runs where it could change the answer. With "
        "XFeat, corners are followed, and the parts of a detection are spread over frames. Network "
        "needed: share of frames for which it ran. First answer: from the start of the imports. "
        "The rows of one size are of three models. What bounds parts above 2 ms: network and local features by XFeat: "
        "convolutions; tracking: Lucas-Kanade forth and back, and the two-view solver; landmarks: products of "
        "descriptors of 7 to 13 keyframes, PnP and its refinement; regions: level sets of seven marginals, of the "
        "image and of the path, in NumPy."
    )
    title, command = "A stream on a small computer", "python benchmarks/streaming.py"
    write_table("streaming", title, command, header, rows, note)


if __name__ == "__main__":
    main()
