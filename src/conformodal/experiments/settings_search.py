"""The search for training settings of the compared networks: each is tried on one part and judged on another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from conformodal.vision import TrainingConfig

from .errors import ExperimentError

_Trained = TypeVar("_Trained")
_BROKEN = 2.0  # a training on more that errs so many times as much as the search's on what it has seen, failed

RATES = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)


class SettingsSearch:
    """Settings tried so far, and their errors.

    Parameters
    ----------
    error
        Trains with settings and judges; a training that broke down may give anything but a finite number.
    report
        Called with trainings done and trainings in all, as far as known.
    """

    def __init__(
        self, error: Callable[[TrainingConfig], float], report: Callable[[int, int], None] | None = None
    ) -> None:
        self._error = error
        self._report = report
        self.errors: dict[TrainingConfig, float] = {}

    @property
    def best(self) -> TrainingConfig:
        """The settings with the least error."""
        return min(self.errors, key=self.errors.__getitem__)

    def try_out(self, *choices: TrainingConfig) -> None:
        """Train with each of these settings, once."""
        new = [settings for settings in dict.fromkeys(choices) if settings not in self.errors]
        for left, settings in zip(range(len(new), 0, -1), new, strict=True):
            if self._report is not None:
                self._report(len(self.errors), len(self.errors) + left)
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
            On what the search judged by, which is now seen: larger than in the search only if training failed.

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
