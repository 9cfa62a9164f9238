"""What a baseline is: something that learns from the classical regressor's problem, and answers with poses.

A new baseline is a function in ``baselines.py``, under :func:`register_baseline`: table 1 trains and tests all that are
registered there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from conformodal.core import FloatArray
from conformodal.odometry import TrainingData
from conformodal.vision import Projection, TrainingConfig

from .classical import ClassicalRegressor
from .errors import ExperimentError
from .plain import known_frames

Features: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Baseline:
    """A trained baseline.

    Attributes
    ----------
    answer
        From features (n, F) to targets (n, 7): metres, and an unnormalised quaternion wxyz.
    n_parameters
        Trained numbers.
    interval
        From features (n, F) to lower and upper ends of calibrated intervals, (n, 7) each; None where it has none.
    """

    answer: Callable[[Features], FloatArray]
    n_parameters: int
    interval: Callable[[Features], tuple[FloatArray, FloatArray]] | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """What baselines learn from: the classical regressor's data, settings, scaling and projection of features.

    Attributes
    ----------
    data
        What all methods learn from.
    classical
        Trained on them.
    alpha
        Miscoverage rate of intervals.
    """

    data: TrainingData
    classical: ClassicalRegressor
    alpha: float = 0.1

    @property
    def config(self) -> TrainingConfig:
        """The settings that the classical regressor's search chose."""
        return self.classical.training

    @property
    def projection(self) -> Projection:
        """Of the features of training and calibration frames."""
        return self.classical.head.projection

    @property
    def known(self) -> npt.NDArray[np.int64]:
        """Training and calibration frames."""
        return known_frames(self.data)

    def standard(self, rows: npt.NDArray[np.int64]) -> FloatArray:
        """Standardised targets (n, 7)."""
        return np.asarray((self.data.targets[rows] - self.classical.mean) / self.classical.scale)

    def metric(self, standard: FloatArray) -> FloatArray:
        """Back from standardised targets."""
        return np.asarray(standard * self.classical.scale + self.classical.mean)


@dataclass(frozen=True)
class BaselineKind:
    """A baseline before it is trained.

    Attributes
    ----------
    label
        For people.
    train
        On a problem.
    is_classical
        Whether it is the classical regressor with other inputs: then it is none of the other methods, the best of
        which stands beside the classical regressor in the table.
    by_default
        Whether it stands in a table that asks for no baselines by name: those do that take seconds to train.
    """

    label: str
    train: Callable[[Problem], Baseline]
    is_classical: bool = False
    by_default: bool = False


BASELINES: dict[str, BaselineKind] = {}


def register_baseline(
    name: str, label: str, *, is_classical: bool = False, by_default: bool = False
) -> Callable[[Callable[[Problem], Baseline]], Callable[[Problem], Baseline]]:
    """Make a baseline known to table 1; decorates the function that trains it.

    Parameters
    ----------
    name
        In records.
    label, is_classical, by_default
        See :class:`BaselineKind`.

    Raises
    ------
    ExperimentError
        If another baseline has that name.
    """

    def register(train: Callable[[Problem], Baseline]) -> Callable[[Problem], Baseline]:
        if name in BASELINES:
            raise ExperimentError(f"there is a baseline {name!r} already: {BASELINES[name].label}")
        BASELINES[name] = BaselineKind(label, train, is_classical, by_default)
        return train

    return register
