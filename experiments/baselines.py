"""Other ways to regress a pose from the same features; a new one is a function here, under :func:`register_baseline`.

The networks have the hidden layer, optimiser and epochs of the tuned regressor. Locally linear regression has no
network: it is one pose source of the conformal method on its own, with a larger search of its settings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.special import log_softmax, softmax

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.features.backbone import feature_views
from conformodal.features.head import Head, Loss, fit_head, mean_squared_error
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import TARGET_NAMES
from conformodal.io import held_out_together
from conformodal.localizer.sources.neighbours import LocalSettings, fit_local
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.plain import known_frames

from .regressors import START_DROPOUT, SettingsSearch, TunedRegressor, root_mean_square
from .tasks import ExperimentError

Features: TypeAlias = npt.NDArray[np.float32]
_D = len(TARGET_NAMES)
N_COMPONENTS = 5  # of the mixture
_LOG_SIGMA = -6.0, 3.0  # least and greatest
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
        mixture = _Mixture.of(head.predict(features), _D)
        return task.metric(mixture.means[np.arange(len(features)), mixture.logits.argmax(axis=1)])

    def error(head: Head) -> float:
        check = data.split.calibration
        return root_mean_square((predict(head, data.features[check]) - data.targets[check])[:, :3])

    search = SettingsSearch(lambda settings: error(task.fit(data.split.train, settings, outputs, mixture_loss)))
    search.walk(task.tuned.training)
    search.try_out(*(replace(search.best, dropout=dropout) for dropout in (0.0, START_DROPOUT)))
    _, head = search.once_more(lambda s: task.fit(known_frames(data), s, outputs, mixture_loss), error)
    return Baseline(lambda features: predict(head, features), head.n_trained)


@register_baseline("deep_ensemble", "deep ensemble of 5")
def deep_ensemble(task: RegressionTask) -> Baseline:
    """The mean of five tuned regressors from different starts (Lakshminarayanan, Pritzel and Blundell 2017)."""
    settings, known = task.tuned.training, known_frames(task.data)
    starts = (replace(settings, seed=settings.seed + 1000 * k) for k in range(1, _N_MEMBERS))
    heads = [task.tuned.head, *(task.fit(known, start, [1] * _D, mean_squared_error) for start in starts)]

    def predict(features: Features) -> FloatArray:
        return task.metric(np.mean([head.predict(features) for head in heads], axis=0))

    return Baseline(predict, sum(head.n_trained for head in heads))


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


class _Mixture(NamedTuple):
    """Mixtures of M diagonal normals over d targets, from raw outputs."""

    logits: FloatArray  # (n, M)
    means: FloatArray  # (n, M, d)
    log_sigma: FloatArray  # (n, M, d), clipped

    @classmethod
    def of(cls, raw: FloatArray, d: int) -> Self:
        """From (n, M (1 + 2 d)) numbers."""
        logits, means, log_sigma = np.split(raw, [N_COMPONENTS, N_COMPONENTS * (1 + d)], axis=1)
        shape = len(raw), N_COMPONENTS, d
        return cls(logits, means.reshape(shape), np.clip(log_sigma.reshape(shape), *_LOG_SIGMA))


def mixture_loss(raw: Features, targets: Features, outputs: Sequence[int]) -> FloatArray:
    """Gradient of the mean negative log likelihood of a mixture of diagonal normals over all targets."""
    mixture = _Mixture.of(raw.astype(np.float64), targets.shape[1])
    z = (targets[:, None] - mixture.means) * np.exp(-mixture.log_sigma)
    log_density = (-0.5 * z**2 - mixture.log_sigma).sum(axis=2)
    share = softmax(log_softmax(mixture.logits, axis=1) + log_density, axis=1)  # of each component in a target
    by_means = -share[..., None] * z * np.exp(-mixture.log_sigma)
    by_log_sigma = share[..., None] * (1 - z**2)
    by_log_sigma[(mixture.log_sigma <= _LOG_SIGMA[0]) | (mixture.log_sigma >= _LOG_SIGMA[1])] = 0  # clipped
    flat = [part.reshape(len(raw), -1) for part in (by_means, by_log_sigma)]
    return np.concatenate([softmax(mixture.logits, axis=1) - share, *flat], axis=1) / len(raw)
