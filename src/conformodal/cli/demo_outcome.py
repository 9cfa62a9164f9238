"""The demo's test part by a model and by the classical regressor, written to disk."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.progress import StageProgress
from conformodal.datasets import Sequence
from conformodal.datasets.corridor.world import CorridorWorld
from conformodal.model.config import ModelConfig
from conformodal.model.model import PoseModel
from conformodal.model.region_rules import EvidenceType
from conformodal.poses import Trajectory
from conformodal.quality.corridor_ambiguity import AmbiguityCheck
from conformodal.running.estimates import OdometryRun
from conformodal.running.paper_odometry import odometry_of
from conformodal.running.results.runs import write_run
from conformodal.running.results.statistics import RegionStatistics
from conformodal.training.plain import train_plain
from conformodal.training.training import prepare_training_data
from conformodal.vision.features import FeatureCache, extract_features

from .outcome import GroundTruth, Part, part_frames, run_metrics


@dataclass(frozen=True, eq=False)
class Outcome:
    """Answers to the test part, the truth, and the content of ``metrics.json``."""

    run: OdometryRun
    truth: Trajectory
    metrics: dict[str, Any]


@dataclass(frozen=True, eq=False)
class DemoResults:
    """Everything that the demo's page shows.

    Attributes
    ----------
    outcome, sequence, model
        The answers to the test part, the flight, and the model that answered.
    world, n_laps
        The corridor, and how often the camera flew through it.
    alike
        Places with the same view.
    folder
        Where the answers are.
    """

    outcome: Outcome
    sequence: Sequence
    model: PoseModel
    world: CorridorWorld
    alike: AmbiguityCheck
    n_laps: int
    folder: Path


def answer_test_part(
    model: PoseModel, config: ModelConfig, out: Path, sequence: Sequence, report: StageProgress
) -> Outcome:
    """Answer the test part by a model, and by a regressor with the same features, epochs and settings."""
    frames = part_frames(model, sequence, Part.TEST)
    cache = FeatureCache(out / "cache")
    started = time.perf_counter()
    result = odometry_of(model).process(sequence, frames, cache=cache, progress=report)
    seconds = round(time.perf_counter() - started, 2)
    paths = [sequence.image_paths[i] for i in result.frames]
    features = extract_features(paths, model.backbone, cache)
    data = prepare_training_data(sequence, config, cache, report)
    classical = train_plain(data, config.training)
    result.trajectories["classical"] = classical.trajectory(features, result.timestamps_s)
    truth = sequence.require_truth()[result.frames]
    write_run(out, result, [path.name for path in paths], truth, "demo")
    counts = {
        "n_answered": len(result.frames),
        "n_unreliable": int(np.sum(~result.reliable)),
        "n_localized": sum(bool(its) for its in result.localization.beliefs.estimates),
        "n_unknown": int(np.sum(result.kinds == EvidenceType.UNKNOWN)),
        "n_without_image": len(result.unreadable),
        "problems": {str(k): v for k, v in result.unreadable.items()},
        "motion": dict(sorted(Counter(str(m.status) for m in result.motions if m is not None).items())),
        "stopped": "",
        "seconds": seconds,
    }
    known = GroundTruth(truth, RegionStatistics.of(result.regions, truth, model.sign_reference, result.kinds))
    metrics = run_metrics(model, Part.TEST, result.trajectories, known, counts)
    return Outcome(result, truth, metrics)
