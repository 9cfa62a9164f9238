"""Regions from trackers of scores, one tracker per target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.calibration.base import Calibrator, Empty
from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, as_doubles
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.regions import Regions
from conformodal.conformal.scalars import brief
from conformodal.conformal.scores import Score
from conformodal.core.arrays import FloatArray, RealArray

from .trackers import Aci, ConformalPid


class Tracker(Protocol):
    """A method that turns a stream of scores into thresholds, one before each score."""

    def threshold(self) -> float:
        """Threshold for the next score; ``inf`` for an unbounded set, ``-inf`` for the empty set."""
        ...

    def update(self, score: float) -> None:
        """Learn the score."""
        ...


METHODS: dict[str, Callable[[Alpha], Tracker]] = {"aci": Aci, "pid": ConformalPid}


class OnlineConformal:
    """Regions for a sequence: predict, see the truth, update.

    For any sequence, the share of misses of a target over T samples differs from alpha by at most

    - ``(max(alpha, 1 - alpha) + 0.005) / (0.005 T)`` with ``"aci"`` (:class:`Aci`),
    - ``(pi/2 sqrt(T) + 1) / T`` with ``"pid"`` (:class:`ConformalPid`).

    Nothing is guaranteed for a single sample, or for the size of sets: against an adversary most are unbounded.

    Parameters
    ----------
    bins
        Fitted bins.
    alpha
        Miscoverage rate in (0, 1), per target.
    score
        As in :class:`~conformodal.conformal.calibration.base.Calibrator`.
    method
        ``"aci"`` or ``"pid"`` with their defaults, or a function that makes a :class:`Tracker` from alpha. ``"aci"``
        stores all past scores, about 40 bytes per sample and target; ``lambda alpha: Aci(alpha, window=1000)`` stores
        the last thousand and has the same bound.
    empty
        ``"allow"`` or ``"mode"``, as for the other calibrators. With ``"mode"`` a threshold of ``-inf`` shows one bin,
        but still counts as a miss.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import Aci, OnlineConformal, QuantileBins
    >>> bins = QuantileBins.from_edges([[0, 1, 2]])
    >>> stream = OnlineConformal(bins, alpha=0.1, method=lambda alpha: Aci(alpha, gamma=0.02))
    >>> proba, y = np.tile([0.7, 0.3], (500, 1)), np.random.default_rng(0).uniform(0, 2, 500)
    >>> bool(abs(stream.run(proba, y).contains(y).mean() - 0.9) < (0.9 + 0.02) / (500 * 0.02))
    True
    """

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        method: str | Callable[[Alpha], Tracker] = "aci",
        empty: Empty = "allow",
    ) -> None:
        self._sets = Calibrator(bins, alpha, score, "none", empty)
        if isinstance(method, str):
            method = METHODS.get(method, method)
        if not callable(method):
            raise ConformalError(f"method must be one of {sorted(METHODS)} or make a Tracker, got {brief(method)}")
        self.bins = bins
        self.trackers = [method(as_alpha(alpha)) for _ in range(bins.n_targets)]
        for tracker in self.trackers:
            if not (callable(getattr(tracker, "threshold", None)) and callable(getattr(tracker, "update", None))):
                raise ConformalError(f"method must make a Tracker, with threshold and update, got {brief(tracker)}")

    @property
    def thresholds(self) -> FloatArray:
        """Current thresholds, (d,)."""
        return as_doubles([tracker.threshold() for tracker in self.trackers], "thresholds")

    def predict(self, proba: Probabilities) -> Regions:
        """Regions of one or more samples at the current thresholds."""
        return self._sets.regions_at(proba, self.thresholds)

    def update(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Learn the truth of samples, in the order of their rows."""
        for scores in self._sets.score_samples(proba, y):
            self._learn(scores)
        return self

    def run(self, proba: Probabilities, y: npt.ArrayLike) -> Regions:
        """Predict and update, row by row: the regions each sample had before its truth was known."""
        limits = []
        for scores in self._sets.score_samples(proba, y):
            limits.append(self.thresholds)
            self._learn(scores)
        if not limits:
            return self.predict(proba)
        return self._sets.regions_at(proba, np.stack(limits))

    def _learn(self, scores: RealArray) -> None:
        for tracker, score in zip(self.trackers, scores, strict=True):
            tracker.update(float(score))
