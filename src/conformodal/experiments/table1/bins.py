"""The same model with fewer and with more bins, as in the paper's figures 2c and 2d."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from conformodal.datasets import Sequence, SplitKind
from conformodal.odometry import (
    METRICS,
    ModelConfig,
    ResultsError,
    VisualOdometry,
    data_digest,
    prepare_training_data,
    provenance,
    read_metrics,
    train_model,
    write_metrics,
    write_run,
)
from conformodal.vision import FeatureCache, TrainingConfig

N_BINS = (10, 50)
ALPHA = 0.1


def bin_runs(
    sequence: Sequence,
    folder: Path,
    split: SplitKind,
    epochs: int,
    cache: FeatureCache,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[int, Path]:
    """Runs on the test part with each number of bins, each target at alpha = 0.1 as in the paper; kept in `folder`."""
    found = {}
    for k in N_BINS:
        place = folder / f"{split}-bins{k}"
        found[k] = place
        config = ModelConfig(
            split=split,
            n_bins=k,
            alpha=ALPHA,
            score="lac",
            joint="none",
            landmarks=False,
            training=TrainingConfig(epochs=epochs),
        )
        settings = {"n_bins": k, "epochs": epochs, "data": data_digest(sequence)}
        if _has(place, settings):
            continue
        data = prepare_training_data(sequence, config, cache, progress)
        model = train_model(data, config, progress=progress)
        run = VisualOdometry(model).process(sequence, data.split.test, cache=cache, progress=progress)
        names = [sequence.image_paths[i].name for i in run.frames]
        write_run(place, run, names, sequence.require_truth()[run.frames], "bins")
        write_metrics(place, {"command": "bins", "provenance": provenance(), "configuration": settings})
    return found


def _has(place: Path, settings: dict[str, Any]) -> bool:
    """Whether a run with these settings is there; one whose record is damaged is made again."""
    if not (place / METRICS).is_file():
        return False
    try:
        return bool(read_metrics(place).get("configuration") == settings)
    except ResultsError:
        return False
