"""One task of table 1: a system and all its baselines are trained, and their errors measured at every noise."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.core.arrays import FloatArray, rows_by_label
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import Trajectory, concatenate, normalise_quat, pose_targets
from conformodal.io import PixelNoise, Recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import hindsight_posteriors
from conformodal.localizer.fusion import fuse
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.modes import Probabilities, interval_runs
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.config import Method
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.evaluate import error_table
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.paper import Greedy
from conformodal.pipeline.plain import PlainRegressor, train_plain, trajectory_of
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import ResultsWriter, record_of
from conformodal.pipeline.stream import whole_paths
from conformodal.pipeline.train import prepare_training_data, train_model

from .baselines import BASELINES, Baseline, RegressionTask
from .conditions import ALPHA, TrainingTask, config_of, run_name
from .regressors import TunedRegressor, train_tuned

_Made = TypeVar("_Made")


@dataclass(frozen=True, eq=False)
class TrainedMethods:
    """A trained system and all that is compared with it."""

    model: PoseModel
    plain: PlainRegressor  # on the same features, with the system's settings
    tuned: TunedRegressor  # the same with searched ones
    baselines: dict[str, Baseline] = field(default_factory=dict)
    # seconds of training, and numbers trained or stored, by the name of a method's trajectory
    cost: dict[str, dict[str, float]] = field(default_factory=dict)


class Table1Worker:
    """Computes tasks on one data set, a recording with poses.

    `runs` is a folder for the runs of seed 0, in the layout of ``conformodal run``: figures are drawn from them. None
    keeps none.
    """

    def __init__(self, sequence: Recording, cache: FeatureCache, runs: Path | None = None) -> None:
        self.sequence, self.cache, self.runs = sequence, cache, runs

    def __call__(self, task: TrainingTask) -> dict[str, Any]:
        """Errors, coverage and cost, by noise; JSON."""
        data = prepare_training_data(self.sequence, config_of(task), self.cache)
        trained = train_all(task, data)
        return {
            "frames": {name: len(data.split.part(name)) for name in ("train", "calibration", "test")},
            "tuned": asdict(trained.tuned.training),
            "cost": trained.cost,
            "noise": {f"{sigma:g}": self._tested(task, trained, sigma) for sigma in task.sigmas},
        }

    def _tested(self, task: TrainingTask, trained: TrainedMethods, sigma: float) -> dict[str, Any]:
        noisy = replace(self.sequence, noise=PixelNoise(sigma, task.seed) if sigma else None)
        model, odometry, test = trained.model, odometry_of(trained.model), trained.model.split.test
        run = odometry.process(noisy, test)
        paths = [self.sequence.image_paths[i] for i in run.frames]
        features = extract_features(paths, model.backbone, self.cache, noise=noisy.noise)
        truth, recording = self.sequence.require_truth()[run.frames], self.sequence.recording[run.frames]
        add_trajectories(trained, run, features, recording)
        if self.runs is not None and task.seed == 0:
            place = self.runs / run_name(task.key, sigma)
            metrics = {"command": "run", "provenance": provenance(), "configuration": model.settings}
            write_run(place, run, [path.name for path in paths], truth, metrics)
        return {
            "errors": error_table(run.trajectories, truth),
            "region": region_numbers(run, model, truth),
            "n_unreliable": int(np.sum(~run.reliable)),
        }


def write_run(
    folder: Path, run: OdometryRun, frame_names: Sequence[str], truth: Trajectory, metrics: dict[str, Any]
) -> None:
    """Write a recording's answers; `frame_names` and `truth` are names and true poses of the answered frames."""
    with ResultsWriter(folder, run.answer) as writer:
        for name, trajectory in run.trajectories.items():
            writer.poses(name, trajectory)
        writer.truth(truth)
        for name, estimate in zip(frame_names, run.estimates, strict=True):
            writer.region(record_of(name, estimate))
    writer.publish(metrics)


def train_all(task: TrainingTask, data: TrainingData) -> TrainedMethods:
    """Train what a task asks for."""
    config = config_of(task)
    model, model_s = _timed(partial(train_model, data, config))
    plain, plain_s = _timed(partial(train_plain, data, config.training))
    tuned, tuned_s = _timed(partial(train_tuned, data, config.training))
    trained = TrainedMethods(model, plain, tuned)
    stored = sum(v.size for s in model.localizer.sources for k, v in s.state().arrays.items() if k != "frames")
    trained.cost["greedy" if task.method is Method.PAPER else "smoothed"] = _cost(model_s, stored)
    trained.cost["plain"], trained.cost["tuned"] = (
        _cost(seconds, regressor.head.n_trained) for regressor, seconds in ((plain, plain_s), (tuned, tuned_s))
    )
    for name in task.baselines:
        baseline, seconds = _timed(partial(BASELINES[name].train, RegressionTask(data, tuned)))
        trained.baselines[name], trained.cost[name] = baseline, _cost(seconds, baseline.n_parameters)
    return trained


def _cost(train_s: float, n_parameters: int) -> dict[str, float]:
    return {"train_s": train_s, "n_parameters": n_parameters}


def _timed(make: Callable[[], _Made]) -> tuple[_Made, float]:
    started = time.perf_counter()
    made = make()
    return made, time.perf_counter() - started


def add_trajectories(
    trained: TrainedMethods, run: OdometryRun, features: npt.NDArray[np.float32], recording: npt.NDArray[np.int64]
) -> None:
    """Add the trajectories of all other methods to a run, which may hold several recordings.

    Beside our system: ``landmarks``, each frame's most probable estimate by landmarks, and the softmax mean where it
    has none; ``no_landmarks``, ours without local features; ``tuned_landmarks``, the tuned regressor's predictions and
    the landmarks' estimates, through our search and smoother.
    """
    model, tuned, times = trained.model, trained.tuned, run.timestamps_s
    beliefs, alone = run.localization.beliefs, model.localizer.beliefs(FrameEvidence(features))
    mean = softmax_mean(alone.proba, model.bins)  # of all images, also those whose place landmarks recognise
    found = {
        "softmax_mean": Trajectory(times, mean[:, :3], mean[:, 3:]),
        "plain": trained.plain.trajectory(features, times),
        "tuned": tuned.trajectory(features, times),
    }
    if model.method is not Method.PAPER:
        pieces, estimates = rows_by_label(recording), beliefs.estimates
        intervals = interval_runs(model.localizer.marginals(beliefs), run.regions)
        greedily = []
        for at in pieces:
            path = Greedy()
            greedily += [path.push(intervals[t], run.estimates[t].relative_motion).at(float(times[t])) for t in at]
        found["greedy"] = concatenate(greedily)
        found["tuned_smoothed"] = tuned.smoothed(features, run, recording, model.prior)
        for name, baseline in trained.baselines.items():
            found[name] = trajectory_of(baseline.predict(features), times)
        single = [fuse(own, [its]) for own, its in zip(_as_mixtures(tuned, features), estimates, strict=True)]
        choices = {"no_landmarks": alone.mixtures, "tuned_landmarks": single}
        for name, candidates in choices.items():
            seen = (replace(run.observations(at), candidates=[candidates[t] for t in at]) for at in pieces)
            found[name] = concatenate(
                [whole_paths(hindsight_posteriors(part, model.prior), part, model.prior)["smoothed"] for part in seen]
            )
        positions, quats = mean[:, :3].copy(), mean[:, 3:].copy()
        for t, its in enumerate(estimates):
            if its:
                best = max(its, key=lambda one: (one.inlier_probability, one.n_inliers))
                positions[t], quats[t] = best.position_xyz, best.orientation_quat_wxyz
        found["landmarks"] = Trajectory(times, positions, quats)
    run.trajectories |= found


def softmax_mean(proba: Probabilities, bins: QuantileBins) -> FloatArray:
    """Mean of every target under its softmax, in bin coordinates, (n, d): the estimate without regions or motion."""
    means = [
        p.astype(np.float64) @ (np.arange(k) + 0.5) / p.sum(axis=1) for p, k in zip(proba, bins.sizes, strict=True)
    ]
    return np.column_stack([np.interp(at, np.arange(len(e)), e) for at, e in zip(means, bins.edges_, strict=True)])


def _as_mixtures(tuned: TunedRegressor, features: npt.NDArray[np.float32]) -> list[PoseMixture]:
    """Predictions of the tuned regressor as mixtures of one hypothesis, one per frame."""
    spread, angle = tuned.spread_m[None], np.array([tuned.spread_rad])
    return [
        PoseMixture.weighted(v[None, :3], spread, normalise_quat(v[None, 3:]), angle, np.zeros(1), measured=False)
        for v in tuned.predict(features)
    ]


def region_numbers(run: OdometryRun, model: PoseModel, truth: Trajectory) -> dict[str, Any]:
    """Coverage and size of the regions: of the pose as calibrated, and of each target at alpha as in the paper."""
    targets = pose_targets(truth, model.sign_reference)
    error = np.linalg.norm(run.trajectory.positions_xyz - truth.positions_xyz, axis=1)

    def numbers(regions: Regions, each: Regions) -> dict[str, Any]:
        widths = np.array([e[-1] - e[0] for e in model.bins.edges_])  # stand for the length of the whole line
        size = np.linalg.norm(np.minimum(regions.length, widths)[:, :3], axis=1)
        length = np.minimum(each.length, widths).mean(axis=0) / targets.std(axis=0)
        return {
            "joint_coverage": float(regions.contains(targets, joint=True).mean()),
            "unbounded": float(regions.unbounded.any(axis=1).mean()),  # which count as covered
            "coverage": float(each.contains(targets).mean()),
            "length": length.tolist(),
            "intervals": float(each.n_intervals.mean()),
            "size_error_rank_correlation": rank_correlation(size, error),
        }

    each: Regions = run.regions
    if model.method is not Method.PAPER:
        rule, parts = model.calibration, model.localizer.marginals_by_part(run.localization.beliefs)
        single = SplitConformal(rule.bins, ALPHA, rule.score, "none").calibrate_scores(rule.scores_, rule.units_)
        each = Regions.concatenate([single.predict(proba) for _, proba in parts])
    return numbers(run.regions, each) | {"n_calibration": model.n_calibration, "n_test": len(targets)}


def rank_correlation(one: FloatArray, other: FloatArray) -> float | None:
    """Spearman's rank correlation of the finite pairs; None where either does not vary."""
    there = np.isfinite(one) & np.isfinite(other)
    a, b = one[there], other[there]
    if len(a) < 2 or not np.ptp(a) or not np.ptp(b):
        return None
    return float(spearmanr(a, b).statistic)
