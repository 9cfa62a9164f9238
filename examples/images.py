"""Images with known poses: train on them, answer the frames that were held out, look at their regions.

python examples/images.py [DATA [OUT]]     without DATA, in a small corridor that is flown through first
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from conformodal import VisualOdometry, read_recording, train_model
from conformodal.corridor import write_corridor
from conformodal.features.settings import TrainingConfig
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.evaluate import RegionStatistics, coverage_table, error_table
from conformodal.pipeline.store import save_model

# Random frames are held out, so that chance alone decides the coverage; the default holds out stretches.
CONFIG = ModelConfig(split="interleaved")
QUICK = ModelConfig(split="interleaved", sources=("head",), training=TrainingConfig(epochs=20))  # for the corridor


def train_and_look(data: Path, config: ModelConfig, out: Path) -> None:
    sequence = read_recording(data)
    model = train_model(sequence, config)
    save_model(model, out / "model")
    run = VisualOdometry(model).process(sequence, model.split.test)
    truth = sequence.require_truth()[run.frames]

    n_boxes = run.regions.n_intervals[:, :3].prod(axis=1)
    most = int(n_boxes.argmax())
    print(f"{sequence.image_paths[run.frames[most]].name}: its region has {n_boxes[most]} boxes; every combination of")
    for axis, parts in zip("xyz", run.regions.intervals(most)[:3], strict=True):
        print(f"  {axis}: " + " or ".join(f"{low:.2f} to {high:.2f} m" for low, high in parts))

    statistics = RegionStatistics.of(run.regions, truth, model.sign_reference, run.kinds)
    held = coverage_table(statistics, model, exchangeable=True)  # frames were held out at random
    low, high = held["joint_band_99"]
    print(f"covered: {held['joint_coverage']:.3f} of {len(truth)} frames; {low:.3f} to {high:.3f} by chance alone")
    print(f"path: {error_table({'': run.trajectory}, truth)['']['rmse_m']:.3f} m (RMSE)")
    print(f"model: {out / 'model'}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        train_and_look(Path(sys.argv[1]), CONFIG, Path(sys.argv[2] if len(sys.argv) > 2 else "images-out"))
    else:
        with TemporaryDirectory() as folder:
            write_corridor(folder, n_modules=2, n_laps=1, seed=0)
            train_and_look(Path(folder), QUICK, Path(folder) / "out")
