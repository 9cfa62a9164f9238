"""The tuned regressor: it shares all but the outputs with the conformal network.

Seven numbers and mean squared error instead of seven softmaxes. It needs no calibration, so it is trained on the
calibration frames too. Learning rate, dropout and number of components are searched: trained on the training part,
validated on the calibration part, then trained once more on both. Rates are searched with and without dropout:
without, squared errors bear a rate three times as high, and do best there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import rows_by_label
from conformodal.features.head import Head
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, angle_between_quats, concatenate, normalise_quat
from conformodal.localizer.observations import MotionPrior, PosePath
from conformodal.localizer.smoother import smooth
from conformodal.localizer.training_data import TrainingData
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.plain import PlainRegressor, fit_values, known_frames, scaling
from conformodal.pipeline.stream import as_trajectory

from .tasks import ExperimentError

_Trained = TypeVar("_Trained")
_BROKEN = 2.0  # a training on more frames failed if it errs so many times as much on validation frames it has seen
RATES = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
_START_RATES = (1e-3, 3e-3)
START_DROPOUT = 0.1
_BATCH_SIZE = 32  # at 64, the conformal network's, errors rose on most splits that were tried
_COMPONENTS = (64, 256)  # besides what the conformal model has; a model of all features has a reason for it


class SettingsSearch:
    """Settings tried so far, and their errors.

    Parameters
    ----------
    error
        Trains with settings and validates; a training that broke down may give anything but a finite number.
    """

    def __init__(self, error: Callable[[TrainingConfig], float]) -> None:
        self._error = error
        self.errors: dict[TrainingConfig, float] = {}

    @property
    def best(self) -> TrainingConfig:
        """The settings with the least error."""
        return min(self.errors, key=self.errors.__getitem__)

    def try_out(self, *choices: TrainingConfig) -> None:
        """Train with each of these settings, once."""
        for settings in choices:
            if settings not in self.errors:
                error = self._error(settings)
                self.errors[settings] = error if math.isfinite(error) else math.inf

    def walk(self, *starts: TrainingConfig) -> None:
        """Down and up :data:`RATES` from settings that differ in their rates alone, until the best is between worse."""
        tried: list[TrainingConfig] = []
        waiting = list(starts)
        while waiting:
            self.try_out(*waiting)
            tried += waiting
            best = min(tried, key=self.errors.__getitem__)
            below = [rate for rate in RATES if rate < best.learning_rate][-1:]
            above = [rate for rate in RATES if rate > best.learning_rate][:1]
            beside = [replace(best, learning_rate=rate) for rate in below + above]
            waiting = [settings for settings in beside if settings not in tried]

    def once_more(
        self, train: Callable[[TrainingConfig], _Trained], error: Callable[[_Trained], float]
    ) -> tuple[TrainingConfig, _Trained]:
        """Train with the best settings on more; with the next best where that breaks down, as high rates do at times.

        Parameters
        ----------
        train
            On all that may be seen.
        error
            On the validation frames, which are now seen: larger than in the search only if training failed.

        Raises
        ------
        ExperimentError
            If nothing was tried out before.
        """
        first: tuple[TrainingConfig, _Trained] | None = None
        for settings in sorted(self.errors, key=self.errors.__getitem__):
            trained = train(settings)
            if error(trained) <= _BROKEN * self.errors[settings]:
                return settings, trained
            first = first or (settings, trained)
        if first is None:
            raise ExperimentError("no settings were tried out yet")
        return first


@dataclass(eq=False)
class TunedRegressor(PlainRegressor):
    """A regressor with settings that were searched.

    Attributes
    ----------
    training
        What the search chose.
    spread_m, spread_rad
        Root mean square error per axis (3,) and of the angle on the calibration part, before the last training:
        what a smoother needs to know.
    """

    training: TrainingConfig
    spread_m: npt.NDArray[np.float64]
    spread_rad: float

    def smoothed(
        self, features: npt.NDArray[np.float32], run: OdometryRun, recording: npt.NDArray[np.int64], prior: MotionPrior
    ) -> Trajectory:
        """Its poses after the conformal method's own smoother, recording by recording."""
        parts = []
        for at in rows_by_label(recording):
            values, seen = self.predict(features[at]), run.observations(at)
            spread, angle = np.broadcast_to(self.spread_m, (len(at), 3)), np.full(len(at), self.spread_rad)
            own = PosePath(seen.timestamps_s, values[:, :3], spread, normalise_quat(values[:, 3:]), angle)
            parts.append(as_trajectory(smooth(own, seen, prior)))
        return concatenate(parts)


def train_tuned(data: TrainingData, config: TrainingConfig) -> TunedRegressor:
    """Search settings, then train on training and calibration parts together.

    The search starts with little dropout, and none of inputs, which squared errors bear badly. It walks down and up
    from two rates in factors of about three until the best rate has a worse one on either side, then again without
    dropout; then more dropout and the other numbers of components are tried with the best settings.

    Parameters
    ----------
    data, config
        What the conformal model was trained on, and how; learning rate, dropout, components and batch size change.
    """
    train, check = data.split.train, data.split.calibration
    mean, scale = scaling(data)
    fit = partial(fit_values, data, (data.targets - mean) / scale)
    misses: dict[TrainingConfig, npt.NDArray[np.float64]] = {}

    def miss(head: Head) -> npt.NDArray[np.float64]:
        return np.asarray(head.predict(data.features[check]) * scale + mean - data.targets[check])

    def error(settings: TrainingConfig) -> float:
        misses[settings] = miss(fit(train, settings))
        return root_mean_square(misses[settings][:, :3])

    config = replace(config, batch_size=_BATCH_SIZE)
    search = SettingsSearch(error)
    little = replace(config, dropout=START_DROPOUT, input_dropout=0.0)
    search.walk(*(replace(little, learning_rate=rate) for rate in _START_RATES))
    search.walk(replace(search.best, dropout=0.0))
    search.try_out(
        replace(search.best, dropout=config.dropout),
        replace(search.best, dropout=config.dropout, input_dropout=config.input_dropout),
        *(replace(search.best, components=k) for k in (() if config.components is None else _COMPONENTS)),
    )
    chosen, head = search.once_more(
        lambda settings: fit(known_frames(data), settings), lambda head: root_mean_square(miss(head)[:, :3])
    )
    truth = data.targets[check]
    angle = angle_between_quats(truth[:, 3:] + misses[chosen][:, 3:], truth[:, 3:])
    return TunedRegressor(
        head=head,
        mean=mean,
        scale=scale,
        training=chosen,
        spread_m=np.sqrt(np.mean(misses[chosen][:, :3] ** 2, axis=0)),
        spread_rad=float(np.sqrt(np.mean(angle**2))),
    )


def root_mean_square(miss: npt.NDArray[np.float64]) -> float:
    """Root mean square length of vectors (n, d)."""
    return float(np.sqrt(np.mean(np.sum(miss**2, axis=1))))
