"""The untuned regressor: seven outputs with mean squared error in place of seven softmaxes.

Features, epochs, optimiser and all other settings are those of the network that it is compared with. It needs no
calibration, so it is trained on the calibration frames too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, IntArray
from conformodal.features.head import Head, fit_head, mean_squared_error
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, normalise_quat
from conformodal.localizer.training_data import TrainingData

_MIN_SCALE = 1e-6  # of a target that does not vary


@dataclass(eq=False)
class PlainRegressor:
    """A regressor of the seven targets of an image."""

    head: Head  # one output per target, standardised
    mean: FloatArray  # (7,) of the targets
    scale: FloatArray  # (7,)

    def predict(self, features: Float32Array) -> FloatArray:
        """Targets (n, 7): metres, and an unnormalised quaternion wxyz."""
        return self.head.predict(features) * self.scale + self.mean

    def trajectory(self, features: Float32Array, timestamps_s: FloatArray) -> Trajectory:
        """The predicted poses at n times, from features (n, F)."""
        return trajectory_of(self.predict(features), timestamps_s)


def trajectory_of(values: FloatArray, timestamps_s: FloatArray) -> Trajectory:
    """Poses at n times from targets (n, 7): metres, and an unnormalised quaternion wxyz."""
    return Trajectory(timestamps_s, values[:, :3], normalise_quat(values[:, 3:]))


def train_plain(data: TrainingData, config: TrainingConfig) -> PlainRegressor:
    """Train on training and calibration part together, with given settings."""
    mean, scale = scaling(data)
    return PlainRegressor(fit_values(data, (data.targets - mean) / scale, known_frames(data), config), mean, scale)


def known_frames(data: TrainingData) -> IntArray:
    """Training and calibration frames, sorted."""
    return np.sort(np.concatenate((data.split.train, data.split.calibration)))


def scaling(data: TrainingData) -> tuple[FloatArray, FloatArray]:
    """Mean and scale (7,) of the targets of all known frames."""
    targets = data.targets[known_frames(data)]
    return targets.mean(axis=0), np.maximum(targets.std(axis=0), _MIN_SCALE)


def fit_values(data: TrainingData, standard: FloatArray, rows: IntArray, config: TrainingConfig) -> Head:
    """Fit one output per target on the frames `rows`; `standard` are the standardised targets (n, 7) of all frames."""
    through, outputs = data.projection(rows, config.components), [1] * standard.shape[1]
    return fit_head(data.features[rows], standard[rows], outputs, mean_squared_error, config, projection=through)
