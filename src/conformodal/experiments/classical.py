"""The tuned baseline: a regressor that shares everything with the conformal network but its outputs.

Same features, trunk, optimiser and epochs; seven numbers and mean squared error instead of seven softmaxes. It needs
no calibration, so it is trained on the calibration frames too. Its learning rate, dropout and number of components are
searched: trained on the training part, judged on the calibration part, then trained once more on both. Rates are
searched with and without dropout: without, squared errors bear a rate three times as high, and do best there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from conformodal.networks import Head, predict_values
from conformodal.odometry import OdometryRun, TrainingData, as_trajectory, rows_by_recording
from conformodal.poses import Trajectory, angle_between_quats, concatenate, normalise_quat
from conformodal.reasoning import MotionPrior, Observations, PosePath, smooth
from conformodal.vision import TrainingConfig

from .plain import PlainRegressor, fit_values, known_frames, scaling
from .settings_search import SettingsSearch

_START_RATES = (1e-3, 3e-3)
START_DROPOUT = 0.1
_FEW_RATES = (3e-4, 1e-3, 3e-3)
_BATCH_SIZE = 32  # at 64, the conformal network's, errors rose on most splits that were tried
_COMPONENTS = (64, 256)  # besides what the conformal model has; a model of all features has a reason for it


@dataclass(eq=False)
class ClassicalRegressor(PlainRegressor):
    """A plain regressor with settings that were searched.

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

    def answers(
        self, features: npt.NDArray[np.float32], seen: Observations, prior: MotionPrior
    ) -> dict[str, Trajectory]:
        """Its trajectory over the frames of a recording, and the same after the conformal method's own smoother."""
        values = self.predict(features)
        n = len(values)
        spread, angle = np.broadcast_to(self.spread_m, (n, 3)), np.full(n, self.spread_rad)
        own = PosePath(seen.timestamps_s, values[:, :3], spread, normalise_quat(values[:, 3:]), angle)
        paths = {"classical": own, "classical_smoothed": smooth(own, seen, prior)}
        return {name: as_trajectory(path) for name, path in paths.items()}

    def trajectories(
        self, features: npt.NDArray[np.float32], run: OdometryRun, recording: npt.NDArray[np.int64], prior: MotionPrior
    ) -> dict[str, Trajectory]:
        """The trajectories of :meth:`answers` over the frames of a run, recording by recording."""
        pieces = rows_by_recording(recording)
        parts = [self.answers(features[at], run.observations(at), prior) for at in pieces]
        return {name: concatenate([part[name] for part in parts]) for name in parts[0]}


def train_classical(
    data: TrainingData,
    config: TrainingConfig,
    progress: Callable[[str, int, int], None] | None = None,
    *,
    whole: bool = False,
    thorough: bool = True,
) -> ClassicalRegressor:
    """Search learning rate, dropout and number of components, then train on training and calibration parts together.

    The search starts with little dropout, and none of inputs, which squared errors bear badly. It walks down and up
    from two rates in factors of about three until the best rate has a worse one on either side, then again without
    dropout; then more dropout and the other numbers of components are tried with the best settings.

    Parameters
    ----------
    data
        What the conformal model was trained on.
    config
        Settings; only learning rate, dropout and components change.
    progress
        Called with stage, trainings done and trainings in all (as far as known).
    whole
        Whether it sees the global descriptor too; by default it sees what the softmax head sees.
    thorough
        False tries three rates with the conformal network's own dropout and nothing else, a third of the trainings.
    """
    train, check = data.split.train, data.split.calibration
    mean, scale = scaling(data)
    fit = partial(fit_values, data, (data.targets - mean) / scale, whole=whole)

    def report(done: int, total: int) -> None:
        if progress is not None:
            progress("classical", done, total + 1)

    misses: dict[TrainingConfig, npt.NDArray[np.float64]] = {}

    def miss(head: Head) -> npt.NDArray[np.float64]:
        return np.asarray(predict_values(head, data.features[check]) * scale + mean - data.targets[check])

    def error(settings: TrainingConfig) -> float:
        misses[settings] = miss(fit(train, settings))
        return root_mean_square(misses[settings][:, :3])

    search = SettingsSearch(error, report)
    if thorough:
        _try_settings(search, config)
    else:
        search.try_out(*(replace(config, learning_rate=rate) for rate in _FEW_RATES))
    report(len(search.errors), len(search.errors))
    chosen, head = search.once_more(
        lambda settings: fit(known_frames(data), settings), lambda head: root_mean_square(miss(head)[:, :3])
    )
    report(len(search.errors) + 1, len(search.errors))
    truth = data.targets[check]
    angle = angle_between_quats(truth[:, 3:] + misses[chosen][:, 3:], truth[:, 3:])
    return ClassicalRegressor(
        head=head,
        mean=mean,
        scale=scale,
        training=chosen,
        spread_m=np.sqrt(np.mean(misses[chosen][:, :3] ** 2, axis=0)),
        spread_rad=float(np.sqrt(np.mean(angle**2))),
    )


def _try_settings(search: SettingsSearch, config: TrainingConfig) -> None:
    """Rates with little dropout and without; then more dropout, and other numbers of components."""
    little = replace(config, dropout=START_DROPOUT, input_dropout=0.0)
    search.walk(*(replace(little, learning_rate=rate) for rate in _START_RATES))
    search.walk(replace(search.best, dropout=0.0))
    choices = () if config.components is None else _COMPONENTS
    search.try_out(
        replace(search.best, dropout=config.dropout),
        replace(search.best, dropout=config.dropout, input_dropout=config.input_dropout),
        *(replace(search.best, components=k) for k in choices),
    )


def baseline_training(config: TrainingConfig) -> TrainingConfig:
    """Settings that baselines start from, beside a conformal network trained with `config`."""
    return replace(config, batch_size=_BATCH_SIZE)


def root_mean_square(miss: npt.NDArray[np.float64]) -> float:
    """Root mean square length of vectors (n, d)."""
    return float(np.sqrt(np.mean(np.sum(miss**2, axis=1))))
