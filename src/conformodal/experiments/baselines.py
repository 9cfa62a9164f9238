"""Other ways to regress a pose from the same features, with the same trunk, optimiser and epochs.

All but the last are networks. Each starts from the settings that were searched for the classical regressor, has its own
rate and dropout searched from there, and is trained on the training and calibration parts together; only conformalised
quantile regression holds the calibration part out, and searches within the training part. The ensemble, and MC dropout
where the classical regressor has dropout, are that regressor again and keep its settings. Locally linear regression has
no network: it is the part of the conformal method's search that is one, on its own.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import numpy.typing as npt
import torch

from conformodal.conformal import conformal_quantile
from conformodal.core import FloatArray
from conformodal.datasets import SplitKind, held_out_together
from conformodal.localization import TARGET_NAMES, target_scale
from conformodal.localization.neighbours import LocalSettings, fit_local
from conformodal.networks import Head, mean_squared_error, predict_values
from conformodal.odometry import TrainingData
from conformodal.vision import feature_views

from .baseline_kinds import BASELINES, Baseline, Features, Problem, register_baseline
from .classical import train_classical
from .losses import (
    N_COMPONENTS,
    WeightedHead,
    learnt_weights_loss,
    mixture_loss,
    pinball_loss,
    split_mixture,
)
from .searched_heads import HeadKind, baseline_of

__all__ = ["BASELINES"]  # all that are registered here

_D = len(TARGET_NAMES)
_N_PASSES, _N_MEMBERS = 30, 5
_LEAST_DROPOUT = 0.03  # of MC dropout
_JUDGED = 5  # one piece of the training part in so many judges the settings of quantile regression
_LOCAL = tuple(
    LocalSettings(components, neighbours, ridge, None)
    for components, neighbours, ridge in product((16, 64, 256), (10, 20, 40), (0.001, 0.01, 0.1))
)


@register_baseline("classical_thumbnail", "classical, sees the thumbnail too", is_classical=True)
def with_thumbnail(problem: Problem) -> Baseline:
    """The classical regressor that sees the global descriptor (the thumbnail) too, with settings searched anew."""
    head = train_classical(problem.data, problem.config, whole=True).head
    return baseline_of(problem, [head], partial(predict_values, head))


@register_baseline("learnt_weights", "classical, learnt loss weights")
def learnt_weights(problem: Problem) -> Baseline:
    """The classical regressor with learnt loss weights."""
    head = HeadKind(learnt_weights_loss, [1] * _D, predict_values, WeightedHead).judged(problem)
    return baseline_of(problem, [head], partial(predict_values, head))


@register_baseline("mixture_density", "mixture density network")
def mixture_density(problem: Problem) -> Baseline:
    """A mixture density network; answers with the mean of its heaviest component."""

    def heaviest(head: Head, features: Features) -> FloatArray:
        raw = torch.from_numpy(predict_values(head, features))
        logits, means, _ = split_mixture(raw, _D)
        return np.asarray(means[torch.arange(len(raw)), logits.argmax(dim=1)].numpy())

    head = HeadKind(mixture_loss, [N_COMPONENTS * (1 + 2 * _D)], heaviest).judged(problem)
    return baseline_of(problem, [head], partial(heaviest, head))


@register_baseline("dropout_passes", "MC dropout, 30 passes")
def dropout_passes(problem: Problem) -> Baseline:
    """The classical regressor, asked 30 times with dropout and averaged (Gal and Ghahramani 2016)."""

    def asked_often(head: Head, features: Features) -> FloatArray:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(problem.config.seed)
            head.train()
            try:
                return np.asarray(np.mean([predict_values(head, features) for _ in range(_N_PASSES)], axis=0))
            finally:
                head.eval()

    # where the search found that dropout does not pay, this method needs some nevertheless
    plain = HeadKind(mean_squared_error, [1] * _D, asked_often, least_dropout=_LEAST_DROPOUT)
    head = problem.classical.head if problem.config.dropout else plain.judged(problem)
    return baseline_of(problem, [head], partial(asked_often, head))


@register_baseline("deep_ensemble", "deep ensemble of 5")
def deep_ensemble(problem: Problem) -> Baseline:
    """The mean of five classical regressors from different starts (Lakshminarayanan, Pritzel and Blundell 2017)."""
    plain = HeadKind(mean_squared_error, [1] * _D, predict_values)
    starts = (replace(problem.config, seed=problem.config.seed + 1000 * k) for k in range(1, _N_MEMBERS))
    others = [plain.fit(problem, problem.known, settings, problem.projection) for settings in starts]
    heads = [problem.classical.head, *others]

    def answer(features: Features) -> FloatArray:
        return np.asarray(np.mean([predict_values(head, features) for head in heads], axis=0))

    return baseline_of(problem, heads, answer)


@register_baseline("quantile_regression", "quantile regression (median)")
def quantile_regression(problem: Problem) -> Baseline:
    """Quantiles by the pinball loss, then calibrated for each target (Romano, Patterson and Candes 2019)."""
    train, held_out, alpha = problem.data.split.train, problem.data.split.calibration, problem.alpha

    def quantiles_of(head: Head, features: Features) -> FloatArray:
        return np.sort(predict_values(head, features).reshape(-1, _D, 3), axis=2)

    loss = pinball_loss((alpha / 2, 0.5, 1 - alpha / 2))
    kind = HeadKind(loss, [3] * _D, lambda head, features: quantiles_of(head, features)[:, :, 1])
    # the calibration part must not even have chosen a rate
    pieces = _pieces(problem.data)[train]
    if len(np.unique(pieces)) < 2:  # one recording trains: its stretches judge
        pieces = held_out_together(problem.data.sequence.recording, SplitKind.BLOCKS)[train]
    judge = np.isin(pieces, np.unique(pieces)[::_JUDGED])
    head = kind.searched(problem, train[~judge], train[judge], train)

    quantiles = partial(quantiles_of, head)
    seen, y = quantiles(problem.data.features[held_out]), problem.standard(held_out)
    slack = conformal_quantile(np.maximum(seen[:, :, 0] - y, y - seen[:, :, 2]), alpha)

    def interval(features: Features) -> tuple[FloatArray, FloatArray]:
        found = quantiles(features)
        return problem.metric(found[:, :, 0] - slack), problem.metric(found[:, :, 2] + slack)

    return replace(baseline_of(problem, [head], partial(kind.answer, head)), interval=interval)


@register_baseline("local_regression", "locally linear regression", by_default=True)
def local_regression(problem: Problem) -> Baseline:
    """Linear regression among the most similar frames (Cleveland 1979), chosen by leaving pieces of the split out."""
    data, known = problem.data, problem.known
    features, targets = data.features[known], data.targets[known]
    views, scale = feature_views(features.shape[1]), target_scale(targets)
    regression, _ = fit_local(features, targets, scale, _pieces(data)[known], choices=_LOCAL, views=views)
    return Baseline(lambda features: regression.predict(features).best, regression.size)


def _pieces(data: TrainingData) -> npt.NDArray[np.int64]:
    sequence = data.sequence
    return held_out_together(sequence.recording, data.split.kind, given_test=sequence.given_test)
