"""One training of the conformal model and of every baseline, and their errors at every noise."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.datasets import PixelNoise, Sequence
from conformodal.localization import FrameEvidence, LocalFeatures, pose_targets
from conformodal.odometry import (
    Method,
    OdometryRun,
    PoseModel,
    TrainingData,
    VisualOdometry,
    prepare_training_data,
    train_model,
    write_run,
)
from conformodal.poses import Trajectory, angle_between_quats, normalise_quat, trajectory_errors
from conformodal.reasoning import smooth, viterbi
from conformodal.vision import FeatureCache, extract_features

from ..baselines import (
    Baseline,
    Problem,
    QuantileIntervals,
    deep_ensemble,
    dropout_passes,
    learnt_weights,
    local_regression,
    mixture_density,
    quantile_regression,
    with_thumbnail,
)
from ..classical import ClassicalRegressor, baseline_training, train_classical
from ..compared_paths import comparison_paths
from ..plain import PlainRegressor, train_plain
from .conditions import ALPHA, TrainingTask, config_of, run_name
from .costs import ms_a_frame, n_numbers, n_stored
from .landmark_rows import landmark_rows
from .motion_memory import MotionMemory
from .paper_work import PaperWorker
from .region_numbers import in_deviations, position_error, position_size, region_numbers


class Table1Worker:
    """Works out training tasks on one data set.

    Parameters
    ----------
    sequence
        With poses.
    cache
        Of features.
    runs
        Folder for the whole runs of seed 0, each in the layout that ``conformodal run`` writes: what figures are
        drawn from. None keeps none.
    """

    def __init__(self, sequence: Sequence, cache: FeatureCache, runs: Path | None = None) -> None:
        self.sequence = sequence
        self.cache = cache
        self.runs = runs
        self._paper = PaperWorker(sequence, cache, runs)
        self._motions = MotionMemory()

    def __call__(self, task: TrainingTask) -> dict[str, Any]:
        """Errors, coverage and cost, by noise; JSON."""
        if task.method is Method.PAPER:
            return self._paper(task)
        config = config_of(task)
        training = config.training
        data = prepare_training_data(self.sequence, config, self.cache)
        started = time.perf_counter()
        model = train_model(data, config)
        conformal_s = time.perf_counter() - started
        started = time.perf_counter()
        classical = train_classical(data, baseline_training(training))
        classical_s = time.perf_counter() - started
        started = time.perf_counter()
        plain = train_plain(data, training)
        plain_s = time.perf_counter() - started
        problem = Problem.of(data, classical)
        quantiles = quantile_regression(problem, ALPHA)
        baselines = {
            "classical_thumbnail": with_thumbnail(problem),
            "learnt_weights": learnt_weights(problem),
            "mixture_density": mixture_density(problem),
            "dropout_passes": dropout_passes(problem, classical),
            "deep_ensemble": deep_ensemble(problem, classical),
            "quantile_regression": quantiles.baseline,
            "local_regression": local_regression(problem),
        }
        cost = {name: {"train_s": b.train_s, "n_parameters": b.n_parameters} for name, b in baselines.items()}
        cost["smoothed"] = {"train_s": conformal_s, "n_parameters": n_stored(model)}
        cost["classical"] = {"train_s": classical_s, "n_parameters": n_numbers(classical.head)}
        cost["plain"] = {"train_s": plain_s, "n_parameters": n_numbers(plain.head)}
        trained = _Trained(task, data, model, classical, plain, baselines, quantiles)
        parts = {name: len(data.split.part(name)) for name in ("train", "calibration", "test")}
        return {
            "frames": parts,
            "classical": asdict(classical.training),
            "cost": cost,
            "noise": {f"{sigma:g}": self._tested(trained, sigma) for sigma in task.sigmas},
        }

    def _tested(self, trained: _Trained, sigma: float) -> dict[str, Any]:
        task, data, model, classical = trained.task, trained.data, trained.model, trained.classical
        noisy = replace(self.sequence, noise=PixelNoise(sigma, task.seed) if sigma else None)
        motions = self._motions.measured(task, noisy, data.split.test)
        run = VisualOdometry(model).process(noisy, data.split.test, cache=self.cache, motions=motions)
        truth, recording = self.sequence.require_truth()[run.frames], self.sequence.recording[run.frames]
        paths = [self.sequence.image_paths[i] for i in run.frames]
        features = extract_features(paths, model.backbone, self.cache, noise=noisy.noise)
        found = {
            **run.trajectories,
            **comparison_paths(run, model, recording),
            "plain": trained.plain.trajectory(features, run.timestamps_s),
            **classical.trajectories(features, run, recording, model.prior),
            **landmark_rows(model, features, run, recording, classical),
        }
        answer_ms = {}
        if not sigma:  # noise costs nothing
            local = [motions.local_features[i] for i in run.frames.tolist()]
            answer_ms = _answer_times(trained, features, local, run, recording)
        for name, baseline in trained.baselines.items():
            values = baseline.answer(features)
            found[name] = Trajectory(run.timestamps_s, values[:, :3], normalise_quat(values[:, 3:]))
        run.trajectories = found
        if self.runs is not None and task.seed == 0:
            write_run(self.runs / run_name(task.key, sigma), run, [path.name for path in paths], truth)
        targets = pose_targets(truth, model.sign_reference)
        lower, upper = trained.quantiles.interval(features)
        return {
            "errors": {name: trajectory_errors(t, truth) for name, t in found.items()},
            "region": region_numbers(run, model, features, truth),
            "frames": _sizes(run, model, truth, recording),
            "quantile_regression": {
                "coverage": float(((targets >= lower) & (targets <= upper)).mean()),
                "length": in_deviations(upper - lower, targets),
            },
            "answer_ms": answer_ms,
            "n_unreliable": int(np.sum(~run.reliable)),
        }


@dataclass(frozen=True, eq=False)
class _Trained:
    task: TrainingTask
    data: TrainingData
    model: PoseModel
    classical: ClassicalRegressor
    plain: PlainRegressor
    baselines: dict[str, Baseline]
    quantiles: QuantileIntervals


def _answer_times(
    trained: _Trained,
    features: npt.NDArray[np.float32],
    local: list[LocalFeatures],
    run: OdometryRun,
    recording: npt.NDArray[np.int64],
) -> dict[str, float]:
    """Milliseconds a frame of every method's answers, once the features are there."""
    started = time.perf_counter()
    _answer(trained.model, features, local, run, recording)  # once: all of it has just been done before
    found = {"smoothed": 1e3 * (time.perf_counter() - started) / len(features)}
    regressors = {"classical": trained.classical.predict, "plain": trained.plain.predict}
    answers = {**regressors, **{k: b.answer for k, b in trained.baselines.items()}}
    return found | {name: ms_a_frame(partial(answer, features), len(features)) for name, answer in answers.items()}


def _answer(
    model: PoseModel,
    features: npt.NDArray[np.float32],
    local: list[LocalFeatures],
    run: OdometryRun,
    recording: npt.NDArray[np.int64],
) -> None:
    """All that leads from features, local features and motions to regions and the smoothed answer, and nothing else."""
    candidates = model.localize(FrameEvidence(features, local)).candidates
    for number in np.unique(recording):
        at = np.flatnonzero(recording == number)
        seen = replace(run.observations(at), candidates=[candidates[t] for t in at])
        smooth(viterbi(seen, model.prior), seen, model.prior)


def _sizes(
    run: OdometryRun, model: PoseModel, truth: Trajectory, recording: npt.NDArray[np.int64]
) -> dict[str, list[float | None]]:
    """The same beside the turning rate since the tested frame before, rad/s; None where there is none."""
    size, error = position_size(run.regions, model), position_error(run, truth)
    quats = truth.orientations_quat_wxyz
    turn = np.full(len(truth), np.nan)
    turn[1:] = angle_between_quats(quats[1:], quats[:-1]) / np.diff(truth.timestamps_s)
    turn[1:][np.diff(recording) != 0] = np.nan
    found = {"size_m": size, "error_m": error, "turn_rad_s": turn}
    return {k: [float(f"{v:.4g}") if np.isfinite(v) else None for v in values] for k, values in found.items()}
