"""One training of the paper's system and of two plain regressors on its features, and their errors at every noise."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from conformodal.datasets import PixelNoise, Sequence
from conformodal.networks import Head
from conformodal.odometry import (
    PaperOdometry,
    PoseModel,
    TrainingData,
    prepare_training_data,
    provenance,
    train_model,
    write_metrics,
    write_run,
)
from conformodal.poses import trajectory_errors
from conformodal.reasoning import greedy, interval_runs
from conformodal.vision import FeatureCache, SoftmaxHead, extract_features

from ..classical import baseline_training, train_classical
from ..compared_paths import comparison_paths
from ..plain import PlainRegressor, train_plain
from .conditions import TrainingTask, config_of, run_name
from .costs import head_of, ms_a_frame, n_numbers
from .motion_memory import MotionMemory
from .region_numbers import paper_numbers


class PaperWorker:
    """Works out the tasks of the paper's method; see :class:`~conformodal.experiments.table1.Table1Worker`."""

    def __init__(self, sequence: Sequence, cache: FeatureCache, runs: Path | None = None) -> None:
        self.sequence = sequence
        self.cache = cache
        self.runs = runs
        self._motions = MotionMemory()

    def __call__(self, task: TrainingTask) -> dict[str, Any]:
        """Errors, coverage and cost, by noise; JSON."""
        config = config_of(task)
        data = prepare_training_data(self.sequence, config, self.cache)
        times = [time.perf_counter()]
        model = train_model(data, config)
        times.append(time.perf_counter())
        plain = train_plain(data, config.training)
        times.append(time.perf_counter())
        classical = train_classical(data, baseline_training(config.training))
        times.append(time.perf_counter())
        heads: dict[str, Head | SoftmaxHead] = {
            "greedy": head_of(model),
            "plain": plain.head,
            "classical": classical.head,
        }
        cost = {
            name: {"train_s": after - before, "n_parameters": n_numbers(head)}
            for (name, head), before, after in zip(heads.items(), times, times[1:], strict=False)
        }
        regressors: dict[str, PlainRegressor] = {"plain": plain, "classical": classical}
        return {
            "frames": {name: len(data.split.part(name)) for name in ("train", "calibration", "test")},
            "classical": asdict(classical.training),
            "cost": cost,
            "noise": {f"{sigma:g}": self._tested(task, data, model, regressors, sigma) for sigma in task.sigmas},
        }

    def _tested(
        self,
        task: TrainingTask,
        data: TrainingData,
        model: PoseModel,
        regressors: dict[str, PlainRegressor],
        sigma: float,
    ) -> dict[str, Any]:
        noisy = replace(self.sequence, noise=PixelNoise(sigma, task.seed) if sigma else None)
        motions = self._motions.measured(task, noisy, data.split.test)
        run = PaperOdometry(model).process(noisy, data.split.test, cache=self.cache, motions=motions)
        truth = self.sequence.require_truth()[run.frames]
        paths = [self.sequence.image_paths[i] for i in run.frames]
        features = extract_features(paths, model.backbone, self.cache, noise=noisy.noise)
        run.trajectories |= comparison_paths(run, model, self.sequence.recording[run.frames])
        for name, regressor in regressors.items():
            run.trajectories[name] = regressor.trajectory(features, run.timestamps_s)
        if self.runs is not None and task.seed == 0:
            place = self.runs / run_name(task.key, sigma)
            write_run(place, run, [path.name for path in paths], truth)
            record = {"command": "run", "provenance": provenance(), "configuration": model.configuration}
            write_metrics(place, record)  # says whose answer it is

        def answer() -> None:
            proba = head_of(model).predict_proba(features)
            greedy(interval_runs(proba, model.calibration.predict(proba)), run.motions, run.timestamps_s)

        answer_ms = {}
        if not sigma:  # noise costs nothing
            answer_ms = {"greedy": ms_a_frame(answer, len(features))}
            for name, regressor in regressors.items():
                answer_ms[name] = ms_a_frame(partial(regressor.predict, features), len(features))
        return {
            "errors": {name: trajectory_errors(t, truth) for name, t in run.trajectories.items()},
            "region": paper_numbers(run, model, truth),
            "answer_ms": answer_ms,
            "n_unreliable": int((~run.reliable).sum()),
        }
