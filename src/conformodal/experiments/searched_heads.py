"""Networks of baselines: trained on standardised targets, their rate and dropout searched as the classical one's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from conformodal.core import FloatArray
from conformodal.networks import Head, Loss, fit_head
from conformodal.vision import Projection, TrainingConfig

from .baseline_kinds import Baseline, Features, Problem
from .classical import START_DROPOUT, root_mean_square
from .losses import N_POSITION
from .settings_search import SettingsSearch


@dataclass(frozen=True, eq=False)
class HeadKind:
    """A kind of network: its loss, its outputs, and how these become predictions.

    Attributes
    ----------
    loss, outputs, head_type
        See :func:`~conformodal.networks.fit_head`.
    answer
        From a head and features (n, F) to standardised targets (n, 7): the prediction.
    least_dropout
        That the search may choose.
    """

    loss: Loss
    outputs: list[int]
    answer: Callable[[Head, Features], FloatArray]
    head_type: type[Head] = Head
    least_dropout: float = 0.0

    def fit(
        self, problem: Problem, rows: npt.NDArray[np.int64], settings: TrainingConfig, projection: Projection
    ) -> Head:
        """Train on some rows; the projection may know these and no others."""
        features, targets = problem.data.features[rows], problem.standard(rows)
        return fit_head(
            features, targets, self.outputs, self.loss, settings, head_type=self.head_type, projection=projection
        )

    def searched(
        self,
        problem: Problem,
        rows: npt.NDArray[np.int64],
        judge: npt.NDArray[np.int64],
        everything: npt.NDArray[np.int64],
    ) -> Head:
        """Trained on everything, with the rate and dropout that did best on `judge` when trained on `rows`."""
        data, components = problem.data, problem.config.components
        part, whole = (data.projection(at, components) for at in (rows, everything))

        def error(head: Head) -> float:
            miss = problem.metric(self.answer(head, data.features[judge])) - data.targets[judge]
            return root_mean_square(miss[:, :N_POSITION])

        search = SettingsSearch(lambda settings: error(self.fit(problem, rows, settings, part)))
        search.walk(replace(problem.config, dropout=max(problem.config.dropout, self.least_dropout)))
        others = {max(dropout, self.least_dropout) for dropout in (0.0, START_DROPOUT)}
        search.try_out(*(replace(search.best, dropout=dropout) for dropout in sorted(others)))
        _, head = search.once_more(lambda settings: self.fit(problem, everything, settings, whole), error)
        return head

    def judged(self, problem: Problem) -> Head:
        """Searched on the training part, judged on the calibration part, trained on both."""
        split = problem.data.split
        return self.searched(problem, split.train, split.calibration, problem.known)


def baseline_of(problem: Problem, heads: list[Head], standard: Callable[[Features], FloatArray]) -> Baseline:
    """The baseline that consists of some heads and predicts what `standard` gives, brought to metric units."""
    size = sum(p.numel() for head in heads for p in head.parameters())
    return Baseline(lambda features: problem.metric(standard(features)), size)
