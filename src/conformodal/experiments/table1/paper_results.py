"""Errors, regions and cost of the paper's system and of two regressors on its features, at one noise."""

from __future__ import annotations

from functools import partial
from typing import Any

from conformodal.odometry import error_table
from conformodal.reasoning import greedy, interval_runs

from ..compared_paths import comparison_paths
from .costs import head_of, ms_a_frame
from .noisy_runs import NoisyRun
from .region_numbers import paper_numbers
from .trained import Trained


def paper_results(trained: Trained, found: NoisyRun) -> dict[str, Any]:
    """Results of one noise; JSON. Trajectories of the other methods are added to the run."""
    model, run, features = trained.model, found.run, found.features
    run.trajectories |= comparison_paths(run, model, found.recording)
    run.trajectories |= {
        "plain": trained.plain.trajectory(features, run.timestamps_s),
        "classical": trained.classical.trajectory(features, run.timestamps_s),
    }

    def answer() -> None:
        proba = head_of(model).predict_proba(features)
        greedy(interval_runs(proba, model.calibration.predict(proba)), run.motions, run.timestamps_s)

    answer_ms = {}
    if not found.sigma:  # noise costs nothing
        answer_ms = {"greedy": ms_a_frame(answer, len(features))}
        for name, predict in trained.predictors.items():
            answer_ms[name] = ms_a_frame(partial(predict, features), len(features))
    return {
        "errors": error_table(run.trajectories, found.truth),
        "region": paper_numbers(run, model, found.truth),
        "answer_ms": answer_ms,
        "n_unreliable": int((~run.reliable).sum()),
    }
