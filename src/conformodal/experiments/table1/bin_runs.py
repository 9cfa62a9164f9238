"""The same model with fewer and with more bins, as in the paper's figures 2c and 2d."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from conformodal.core.choices import as_member
from conformodal.datasets import Sequence, SplitKind
from conformodal.odometry import (
    METRICS,
    Method,
    ModelConfig,
    MotionRecord,
    ResultsError,
    data_digest,
    odometry_of,
    prepare_training_data,
    provenance,
    read_metrics,
    save_model,
    train_model,
    write_metrics,
    write_run,
)
from conformodal.vision import FeatureCache, TrainingConfig

from ..errors import ExperimentError
from .conditions import ALPHA

_N_BINS = (10, 50)
MODEL = "model"  # folder of a run's model


def bin_runs(
    sequence: Sequence,
    folder: Path,
    split: SplitKind | str,
    epochs: int,
    cache: FeatureCache,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    method: Method | str = Method.CONFORMODAL,
) -> dict[int, Path]:
    """Runs on the test part with each number of bins, each target at alpha = 0.1 as in the paper.

    They are kept in `folder`, each with its model.
    """
    method = as_member(method, Method, "method", ExperimentError)
    found = {}
    motions: MotionRecord | None = None  # both have the same test frames
    for k in _N_BINS:
        place = folder / (f"{method}-{split}-bins{k}" if method is Method.PAPER else f"{split}-bins{k}")
        found[k] = place
        config = _config(method, split, k, TrainingConfig(epochs=epochs))
        settings = {"method": str(method), "n_bins": k, "epochs": epochs, "data": data_digest(sequence)}
        if _has(place, settings):
            continue
        data = prepare_training_data(sequence, config, cache, progress)
        model = train_model(data, config, progress=progress)
        odometry = odometry_of(model)
        motions = motions or odometry.measure_motions(sequence, data.split.test, progress)
        run = odometry.process(sequence, data.split.test, cache=cache, motions=motions, progress=progress)
        names = [sequence.image_paths[i].name for i in run.frames]
        write_run(place, run, names, sequence.require_truth()[run.frames], "bins")
        save_model(model, place / MODEL)
        write_metrics(place, {"command": "bins", "provenance": provenance(), "configuration": settings})
    return found


def _config(method: Method, split: SplitKind | str, n_bins: int, training: TrainingConfig) -> ModelConfig:
    settings: dict[str, Any] = {"split": split, "n_bins": n_bins, "alpha": ALPHA, "training": training}
    if method is Method.PAPER:
        return ModelConfig.paper(**settings)
    return ModelConfig(**settings, score="lac", joint="none", sources=("head",))


def _has(place: Path, settings: dict[str, Any]) -> bool:
    """Whether a run with these settings is there; one whose record is damaged is made again."""
    if not (place / METRICS).is_file():
        return False
    try:
        return bool(read_metrics(place).get("configuration") == settings)
    except ResultsError:
        return False
