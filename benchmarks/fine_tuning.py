"""Frozen features beside fine-tuned ones, on redkitchen, both splits: conformal and classical errors.

python benchmarks/fine_tuning.py
"""

from __future__ import annotations

import time

from common import DATA, write_table

from conformodal.datasets import SplitKind, read_sevenscenes
from conformodal.experiments import error_table, train_classical
from conformodal.odometry import ModelConfig, VisualOdometry, measure_motions, prepare_training_data, train_model
from conformodal.vision import FeatureCache, FineTuning, default_cache_dir

VARIANTS = {"frozen": None, "last 3 blocks": FineTuning(blocks=3)}


def main() -> None:
    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    cache = FeatureCache(default_cache_dir())
    rows = []
    for split in SplitKind:
        motions = None
        for name, tuning in VARIANTS.items():
            config = ModelConfig(split=split, fine_tuning=tuning)
            started = time.perf_counter()
            data = prepare_training_data(sequence, config, cache)
            seconds = time.perf_counter() - started
            model = train_model(data, config)
            classical = train_classical(data, config.training, config.components)
            motions = motions or measure_motions(sequence, data.split.test)
            run = VisualOdometry(model).process(sequence, data.split.test, cache=cache, motions=motions)
            recording = sequence.recording[run.frames]
            found = run.trajectories | classical.trajectories(data.features[run.frames], run, recording, model.prior)
            errors = error_table(found, sequence.require_truth()[run.frames])
            methods = ("smoothed", "softmax_mean", "classical", "classical_smoothed")
            cells = [f"{errors[m]['rmse_m']:.4f}" for m in methods]
            rows.append([str(split), name, *cells, f"{errors['smoothed']['rmse_deg']:.2f}", f"{seconds:.0f}"])
    header = ["split", "network", "conformal, m", "softmax mean, m", "classical, m", "classical, same smoother, m"]
    header += ["conformal, degrees", "tuning and features, s"]
    note = (
        "Seed 0, 10 epochs of fine-tuning on the training part with the softmax loss; both methods learn from the same "
        "features. Seconds are near zero where the cache had the features."
    )
    title = "Fine-tuning EfficientNet-Lite0: redkitchen, 640 training frames"
    write_table("fine_tuning", title, "python benchmarks/fine_tuning.py", header, rows, note)


if __name__ == "__main__":
    main()
