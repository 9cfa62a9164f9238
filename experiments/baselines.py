"""Other ways to regress a pose from the same features; a new one is a function here, under :func:`register_baseline`.

The networks have trunk, optimiser and epochs of the tuned regressor. Locally linear regression has no network: it is
one pose source of the conformal method on its own, with a larger search of its settings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.features.backbone import feature_views
from conformodal.features.heads import Head, Loss, fit_head, mean_squared_error, predict_values
from conformodal.features.settings import TrainingConfig
from conformodal.io import held_out_together
from conformodal.localizer.candidates import TARGET_NAMES
from conformodal.localizer.sources.neighbours import LocalSettings, fit_local
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.plain import known_frames

from .regressors import START_DROPOUT, SettingsSearch, TunedRegressor, root_mean_square
from .tasks import ExperimentError

Features: TypeAlias = npt.NDArray[np.float32]
_D = len(TARGET_NAMES)
N_COMPONENTS = 5  # of the mixture
_N_MEMBERS = 5  # of the ensemble
_LOCAL = tuple(LocalSettings(*c, None) for c in product((16, 64, 256), (10, 20, 40), (0.001, 0.01, 0.1)))


@dataclass(frozen=True, eq=False)
class Baseline:
    """A trained baseline.

    Attributes
    ----------
    predict
        From features (n, F) to targets (n, 7): metres, and an unnormalised quaternion wxyz.
    n_parameters
        Trained numbers.
    """

    predict: Callable[[Features], FloatArray]
    n_parameters: int


@dataclass(frozen=True, eq=False)
class RegressionTask:
    """What baselines learn from: the tuned regressor's data, settings and scaling."""

    data: TrainingData
    tuned: TunedRegressor

    def fit(self, rows: IntArray, settings: TrainingConfig, outputs: list[int], loss: Loss) -> Head:
        """A network trained on some rows; its projection of features knows these and no others."""
        standard = (self.data.targets[rows] - self.tuned.mean) / self.tuned.scale
        projection = self.data.projection(rows, settings.components)
        return fit_head(self.data.features[rows], standard, outputs, loss, settings, projection=projection)

    def metric(self, standard: FloatArray) -> FloatArray:
        """Back from standardised targets."""
        return np.asarray(standard * self.tuned.scale + self.tuned.mean)


@dataclass(frozen=True)
class BaselineKind:
    """A baseline before it is trained: its name for people, and whether a table has it unless all are asked for."""

    label: str
    train: Callable[[RegressionTask], Baseline]
    by_default: bool


BASELINES: dict[str, BaselineKind] = {}
_Train: TypeAlias = Callable[[RegressionTask], Baseline]


def register_baseline(name: str, label: str, *, by_default: bool = False) -> Callable[[_Train], _Train]:
    """Make a baseline known to the table; decorates the function that trains it.

    Raises
    ------
    ExperimentError
        If another baseline has that name.
    """

    def register(train: _Train) -> _Train:
        if name in BASELINES:
            raise ExperimentError(f"there is a baseline {name!r} already: {BASELINES[name].label}")
        BASELINES[name] = BaselineKind(label, train, by_default)
        return train

    return register


@register_baseline("mixture_density", "mixture density network")
def mixture_density(task: RegressionTask) -> Baseline:
    """A mixture density network (Bishop 1994), rate and dropout searched; the mean of its heaviest component."""
    data, outputs = task.data, [N_COMPONENTS * (1 + 2 * _D)]

    def predict(head: Head, features: Features) -> FloatArray:
        raw = torch.from_numpy(predict_values(head, features))
        logits, means, _ = split_mixture(raw, _D)
        return task.metric(means[torch.arange(len(raw)), logits.argmax(dim=1)].numpy())

    def error(head: Head) -> float:
        check = data.split.calibration
        return root_mean_square((predict(head, data.features[check]) - data.targets[check])[:, :3])

    search = SettingsSearch(lambda settings: error(task.fit(data.split.train, settings, outputs, mixture_loss)))
    search.walk(task.tuned.training)
    search.try_out(*(replace(search.best, dropout=dropout) for dropout in (0.0, START_DROPOUT)))
    _, head = search.once_more(lambda s: task.fit(known_frames(data), s, outputs, mixture_loss), error)
    return Baseline(lambda features: predict(head, features), n_numbers(head))


@register_baseline("deep_ensemble", "deep ensemble of 5")
def deep_ensemble(task: RegressionTask) -> Baseline:
    """The mean of five tuned regressors from different starts (Lakshminarayanan, Pritzel and Blundell 2017)."""
    settings, known = task.tuned.training, known_frames(task.data)
    starts = (replace(settings, seed=settings.seed + 1000 * k) for k in range(1, _N_MEMBERS))
    heads = [task.tuned.head, *(task.fit(known, start, [1] * _D, mean_squared_error) for start in starts)]

    def predict(features: Features) -> FloatArray:
        return task.metric(np.mean([predict_values(head, features) for head in heads], axis=0))

    return Baseline(predict, sum(n_numbers(head) for head in heads))


@register_baseline("local_regression", "locally linear regression", by_default=True)
def local_regression(task: RegressionTask) -> Baseline:
    """Linear regression among the most similar frames (Cleveland 1979), chosen by leaving pieces of the split out."""
    data, rows = task.data, known_frames(task.data)
    features, targets = data.features[rows], data.targets[rows]
    pieces = held_out_together(data.sequence.recording, data.split.kind, given_test=data.sequence.given_test)[rows]
    views = feature_views(features.shape[1])
    regression = fit_local(features, targets, pieces, choices=_LOCAL, views=views).regression.slim()

    def predict(features: Features) -> FloatArray:
        return regression.predict(regression.projection.apply(features)).values[:, 0]

    return Baseline(predict, regression.references.size + regression.targets.size)


def mixture_loss(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Negative log likelihood of a mixture of diagonal normals over all targets, without its constant."""
    logits, means, log_sigma = split_mixture(raw, targets.shape[1])
    z = (targets[:, None] - means) * torch.exp(-log_sigma)
    log_density = (-0.5 * z**2 - log_sigma).sum(dim=2)
    return -torch.logsumexp(torch.log_softmax(logits, dim=1) + log_density, dim=1).mean()


def split_mixture(raw: torch.Tensor, d: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Logits (n, M), means (n, M, d) and log spreads (n, M, d), the last clipped."""
    logits, means, log_sigma = torch.split(raw, [N_COMPONENTS, N_COMPONENTS * d, N_COMPONENTS * d], dim=1)
    return logits, means.reshape(-1, N_COMPONENTS, d), log_sigma.reshape(-1, N_COMPONENTS, d).clamp(-6, 3)


def n_numbers(head: Head) -> int:
    """Trained numbers of a head."""
    return sum(p.numel() for p in head.parameters())
