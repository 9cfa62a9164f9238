"""What one task of table 1 trains: a system, two regressors on its features, and the other baselines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from conformodal.core import FloatArray
from conformodal.odometry import Method, PoseModel, TrainingData, train_model

from ..baseline_kinds import Baseline, Features, Problem
from ..baselines import BASELINES
from ..classical import ClassicalRegressor, baseline_training, train_classical
from ..plain import PlainRegressor, train_plain
from .conditions import ALPHA, TrainingTask, config_of
from .costs import head_of, n_numbers, n_stored, timed

Cost = dict[str, float | int]


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained system, and all that is compared with it.

    Attributes
    ----------
    model
        The system.
    plain, classical
        Regressors on the same features, with the system's settings and with searched ones.
    baselines
        By name; none beside the paper's system.
    cost
        Of each method, by the name of its trajectory: seconds of training, and numbers trained or stored.
    """

    model: PoseModel
    plain: PlainRegressor
    classical: ClassicalRegressor
    baselines: dict[str, Baseline] = field(default_factory=dict)
    cost: dict[str, Cost] = field(default_factory=dict)

    @property
    def predictors(self) -> dict[str, Callable[[Features], FloatArray]]:
        """Regressors by name, each from features (n, F) to targets (n, 7)."""
        others = {name: baseline.answer for name, baseline in self.baselines.items()}
        return {"classical": self.classical.predict, "plain": self.plain.predict, **others}


def train_all(task: TrainingTask, data: TrainingData) -> Trained:
    """Train what a task asks for."""
    config = config_of(task)
    model, model_s = timed(partial(train_model, data, config))
    plain, plain_s = timed(partial(train_plain, data, config.training))
    classical, classical_s = timed(partial(train_classical, data, baseline_training(config.training)))
    trained = Trained(model, plain, classical)
    trained.cost["plain"] = _cost(plain_s, n_numbers(plain.head))
    trained.cost["classical"] = _cost(classical_s, n_numbers(classical.head))
    if task.method is Method.PAPER:
        trained.cost["greedy"] = _cost(model_s, n_numbers(head_of(model)))
        return trained
    trained.cost["smoothed"] = _cost(model_s, n_stored(model))
    problem = Problem(data, classical, ALPHA)
    for name, kind in BASELINES.items():
        trained.baselines[name], seconds = timed(partial(kind.train, problem))
        trained.cost[name] = _cost(seconds, trained.baselines[name].n_parameters)
    return trained


def _cost(train_s: float, n_parameters: int) -> Cost:
    return {"train_s": train_s, "n_parameters": n_parameters}
