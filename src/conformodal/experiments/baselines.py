"""Other ways to regress a pose from the same features, with the same trunk, optimiser and epochs.

All but the last are networks. Each starts from the settings that were searched for the classical regressor, has its own
rate and dropout searched from there, and is trained on the training and calibration parts together; only conformalised
quantile regression holds the calibration part out, and searches within the training part. The ensemble, and MC dropout
where the classical regressor has dropout, are that regressor again and keep its settings. Locally linear regression has
no network: it is the part of the conformal method's search that is one, on its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from conformodal.conformal import conformal_quantile
from conformodal.core import FloatArray
from conformodal.datasets import SplitKind, held_out_together
from conformodal.localization import target_scale
from conformodal.localization.neighbours import LocalSettings, fit_local
from conformodal.networks import Head, fit_head, mean_squared_error, predict_values
from conformodal.odometry import TrainingData
from conformodal.vision import Projection, TrainingConfig, feature_views

from .classical import START_DROPOUT, ClassicalRegressor, root_mean_square, train_classical
from .losses import (
    N_COMPONENTS,
    N_POSITION,
    WeightedHead,
    learnt_weights_loss,
    mixture_loss,
    pinball_loss,
    split_mixture,
)
from .plain import known_frames
from .settings_search import SettingsSearch

Features: TypeAlias = npt.NDArray[np.float32]
Answer: TypeAlias = Callable[[Features], FloatArray]

N_PASSES, N_MEMBERS = 30, 5
_LEAST_DROPOUT = 0.03  # of MC dropout
_JUDGED = 5  # one piece of the training part in so many judges the settings of quantile regression
_LOCAL = tuple(
    LocalSettings(components, neighbours, ridge, None)
    for components, neighbours, ridge in product((16, 64, 256), (10, 20, 40), (0.001, 0.01, 0.1))
)


@dataclass(frozen=True, eq=False)
class Baseline:
    """A trained baseline.

    Attributes
    ----------
    answer
        From features (n, F) to targets (n, 7): metres, and an unnormalised quaternion wxyz.
    train_s
        Seconds of training.
    n_parameters
        Trained numbers.
    """

    answer: Answer
    train_s: float
    n_parameters: int


@dataclass(frozen=True, eq=False)
class Problem:
    """What baselines learn from: the classical regressor's data, settings, scaling and projection of features."""

    data: TrainingData
    config: TrainingConfig
    mean: FloatArray
    scale: FloatArray
    projection: Projection

    @classmethod
    def of(cls, data: TrainingData, classical: ClassicalRegressor) -> Problem:
        """The classical regressor's problem."""
        return cls(data, classical.training, classical.mean, classical.scale, classical.head.projection)

    @property
    def known(self) -> npt.NDArray[np.int64]:
        """Training and calibration frames."""
        return known_frames(self.data)

    def standard(self, rows: npt.NDArray[np.int64]) -> FloatArray:
        """Standardised targets (n, 7)."""
        return np.asarray((self.data.targets[rows] - self.mean) / self.scale)

    def metric(self, standard: FloatArray) -> FloatArray:
        """Back from standardised targets."""
        return np.asarray(standard * self.scale + self.mean)


def with_thumbnail(problem: Problem) -> Baseline:
    """The classical regressor that sees the thumbnail too, with settings searched anew."""
    started = time.perf_counter()
    head = train_classical(problem.data, problem.config, whole=True).head
    return _trained(problem, [head], started, lambda features: predict_values(head, features))


def learnt_weights(problem: Problem) -> Baseline:
    """The classical regressor with learnt loss weights."""
    started = time.perf_counter()
    head = _judged(problem, _Kind(learnt_weights_loss, [1] * problem.mean.size, predict_values, WeightedHead))
    return _trained(problem, [head], started, lambda features: predict_values(head, features))


def mixture_density(problem: Problem) -> Baseline:
    """A mixture density network; answers with the mean of its heaviest component."""
    d = problem.mean.size
    started = time.perf_counter()

    def heaviest(head: Head, features: Features) -> FloatArray:
        raw = torch.from_numpy(predict_values(head, features))
        logits, means, _ = split_mixture(raw, d)
        return np.asarray(means[torch.arange(len(raw)), logits.argmax(dim=1)].numpy())

    head = _judged(problem, _Kind(mixture_loss, [N_COMPONENTS * (1 + 2 * d)], heaviest))
    return _trained(problem, [head], started, lambda features: heaviest(head, features))


def dropout_passes(problem: Problem, classical: ClassicalRegressor) -> Baseline:
    """The classical regressor, asked 30 times with dropout and averaged (Gal and Ghahramani 2016)."""
    started = time.perf_counter()

    def asked_often(head: Head, features: Features) -> FloatArray:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(problem.config.seed)
            head.train()
            try:
                return np.asarray(np.mean([predict_values(head, features) for _ in range(N_PASSES)], axis=0))
            finally:
                head.eval()

    # where the search found that dropout does not pay, this method needs some nevertheless
    plain = _Kind(mean_squared_error, [1] * problem.mean.size, asked_often, least_dropout=_LEAST_DROPOUT)
    head = classical.head if classical.training.dropout else _judged(problem, plain)
    return _trained(problem, [head], started, lambda features: asked_often(head, features))


def deep_ensemble(problem: Problem, classical: ClassicalRegressor) -> Baseline:
    """The mean of five classical regressors from different starts (Lakshminarayanan, Pritzel and Blundell 2017)."""
    started = time.perf_counter()
    seeds = (problem.config.seed + 1000 * k for k in range(1, N_MEMBERS))
    plain = _Kind(mean_squared_error, [1] * problem.mean.size, predict_values)
    heads = [
        classical.head,
        *(plain.fit(problem, problem.known, replace(problem.config, seed=seed), problem.projection) for seed in seeds),
    ]

    def answer(features: Features) -> FloatArray:
        return np.asarray(np.mean([predict_values(head, features) for head in heads], axis=0))

    return _trained(problem, heads, started, answer)


@dataclass(frozen=True, eq=False)
class QuantileIntervals:
    """Conformalised quantile regression, one interval a target.

    Attributes
    ----------
    baseline
        Answers with the median.
    interval
        From features (n, F) to lower and upper ends, (n, 7) each.
    """

    baseline: Baseline
    interval: Callable[[Features], tuple[FloatArray, FloatArray]]


def quantile_regression(problem: Problem, alpha: float) -> QuantileIntervals:
    """Quantiles by the pinball loss, then calibrated for each target (Romano, Patterson and Candes 2019)."""
    d = problem.mean.size
    train, held_out = problem.data.split.train, problem.data.split.calibration
    started = time.perf_counter()

    def quantiles_of(head: Head, features: Features) -> FloatArray:
        return np.sort(predict_values(head, features).reshape(-1, d, 3), axis=2)

    loss = pinball_loss((alpha / 2, 0.5, 1 - alpha / 2))
    kind = _Kind(loss, [3] * d, lambda head, features: quantiles_of(head, features)[:, :, 1])
    # the calibration part must not even have chosen a rate
    pieces = _pieces(problem.data)[train]
    if len(np.unique(pieces)) < 2:  # one recording trains: its stretches judge
        pieces = held_out_together(problem.data.sequence.recording, SplitKind.BLOCKS)[train]
    judge = np.isin(pieces, np.unique(pieces)[::_JUDGED])
    head = _searched(problem, kind, train[~judge], train[judge], train)

    quantiles = partial(quantiles_of, head)
    seen, y = quantiles(problem.data.features[held_out]), problem.standard(held_out)
    slack = conformal_quantile(np.maximum(seen[:, :, 0] - y, y - seen[:, :, 2]), alpha)

    def interval(features: Features) -> tuple[FloatArray, FloatArray]:
        found = quantiles(features)
        return problem.metric(found[:, :, 0] - slack), problem.metric(found[:, :, 2] + slack)

    return QuantileIntervals(_trained(problem, [head], started, lambda x: quantiles(x)[:, :, 1]), interval)


def local_regression(problem: Problem) -> Baseline:
    """Linear regression among the most similar frames (Cleveland 1979), chosen by leaving pieces of the split out."""
    data, known = problem.data, problem.known
    pieces = _pieces(data)[known]
    started = time.perf_counter()
    targets = data.targets[known]
    features = data.features[known]
    views = feature_views(features.shape[1])
    regression, _ = fit_local(features, targets, target_scale(targets), pieces, choices=_LOCAL, views=views)
    seconds = time.perf_counter() - started
    return Baseline(lambda features: regression.predict(features).best, seconds, regression.size)


def _pieces(data: TrainingData) -> npt.NDArray[np.int64]:
    sequence = data.sequence
    return held_out_together(sequence.recording, data.split.kind, given_test=sequence.given_test)


@dataclass(frozen=True, eq=False)
class _Kind:
    """What a network is trained to do, and what it then answers: standardised targets (n, 7)."""

    loss: Any
    outputs: list[int]
    answer: Callable[[Head, Features], FloatArray]
    head_type: type[Head] = Head
    least_dropout: float = 0.0

    def fit(
        self,
        problem: Problem,
        rows: npt.NDArray[np.int64],
        settings: TrainingConfig,
        projection: Projection | None = None,
    ) -> Head:
        """Train on some rows; a projection may know these and no others."""
        features, targets = problem.data.features[rows], problem.standard(rows)
        return fit_head(
            features, targets, self.outputs, self.loss, settings, head_type=self.head_type, projection=projection
        )


def _searched(
    problem: Problem,
    kind: _Kind,
    rows: npt.NDArray[np.int64],
    judge: npt.NDArray[np.int64],
    everything: npt.NDArray[np.int64],
) -> Head:
    """Trained on everything, with the rate and dropout that did best on `judge` when trained on `rows`."""
    data, components = problem.data, problem.config.components
    part, whole = (data.projection(at, components) for at in (rows, everything))

    def error(head: Head) -> float:
        miss = problem.metric(kind.answer(head, data.features[judge])) - data.targets[judge]
        return root_mean_square(miss[:, :N_POSITION])

    search = SettingsSearch(lambda settings: error(kind.fit(problem, rows, settings, part)))
    search.walk(replace(problem.config, dropout=max(problem.config.dropout, kind.least_dropout)))
    others = {max(dropout, kind.least_dropout) for dropout in (0.0, START_DROPOUT)}
    search.try_out(*(replace(search.best, dropout=dropout) for dropout in sorted(others)))
    _, head = search.once_more(lambda settings: kind.fit(problem, everything, settings, whole), error)
    return head


def _judged(problem: Problem, kind: _Kind) -> Head:
    """Searched on the training part, judged on the calibration part, trained on both."""
    return _searched(problem, kind, problem.data.split.train, problem.data.split.calibration, problem.known)


def _trained(problem: Problem, heads: list[Head], started: float, standard: Answer) -> Baseline:
    seconds = time.perf_counter() - started
    size = sum(p.numel() for head in heads for p in head.parameters())
    return Baseline(lambda features: problem.metric(standard(features)), seconds, size)
