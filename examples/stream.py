"""A video, a camera or a ROS recording, frame by frame: region and pose of each image as it comes.

python examples/stream.py [MODEL SOURCE]     SOURCE: a video, camera:0, a .bag or .mcap, a folder of images; without
                                             any, a model and a flight of a small corridor, made here
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from conformodal import PoseModel, VisualOdometry, open_stream, read_recording, train_model
from conformodal.corridor import write_corridor
from conformodal.features.settings import TrainingConfig
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.store import load_model


def small_model(folder: Path) -> PoseModel:
    sequence = read_recording(write_corridor(folder, n_modules=2, n_laps=1, seed=0))
    config = ModelConfig(sources=("head",), training=TrainingConfig(epochs=20))
    return train_model(sequence, config)


def follow(model: PoseModel, source: Path | str, most: int | None = None) -> None:
    vo = VisualOdometry(model)
    recording = 0
    for number, frame in enumerate(open_stream(source, camera=model.camera), start=1):
        if frame.recording != recording:
            recording = frame.recording
            vo.reset()  # motion is never linked across recordings
        estimate = vo.step(frame.image, frame.timestamp_s)
        if estimate.pose is None:
            print(f"{frame.name}: no answer: {estimate.problem}")
        else:
            x, y, z = estimate.pose.position_xyz
            region = " or ".join(f"{low:.2f} to {high:.2f}" for low, high in estimate.region.intervals(0)[0])
            print(f"{frame.name}: x {x:.2f}  y {y:.2f}  z {z:.2f} m; region in x: {region} m  {estimate.problem}")
        if number == most:
            break


if __name__ == "__main__":
    if len(sys.argv) > 2:
        follow(load_model(Path(sys.argv[1])), sys.argv[2])
    else:
        with TemporaryDirectory() as folder:
            follow(small_model(Path(folder)), folder, most=12)
