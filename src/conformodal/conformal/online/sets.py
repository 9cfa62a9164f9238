"""Regions from trackers of scores, one tracker a target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from ..bins import QuantileBins
from ..calibration.base import Calibrator, Empty
from ..checks import Alpha, Probabilities, as_alpha
from ..errors import ConformalError
from ..regions import Regions
from ..scores import Score
from .aci import Aci, DtAci
from .pid import ConformalPid


class Tracker(Protocol):
    """What turns a stream of scores into thresholds, one before each score."""

    def threshold(self) -> float:
        """Threshold for the next score; ``inf`` for the whole space, ``-inf`` for the empty set."""
        ...

    def update(self, score: float) -> None:
        """Learn the score that came."""
        ...


METHODS: dict[str, Callable[[Alpha], Tracker]] = {"aci": Aci, "dtaci": DtAci, "pid": ConformalPid}


class OnlineConformal:
    """Regions for a sequence: predict, see the truth, update.

    Nothing is assumed about the sequence; the long-run share of misses approaches alpha for each target, as its
    tracker's source proves. It says nothing about any single sample.

    Parameters
    ----------
    bins
        Fitted bins.
    alpha
        Miscoverage rate in (0, 1), of each target alone.
    score
        As in :class:`~conformodal.conformal.calibration.base.Calibrator`.
    method
        ``"aci"``, ``"dtaci"`` or ``"pid"`` with their defaults, or a function that makes a :class:`Tracker` from alpha.
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
        method: str | Callable[[Alpha], Tracker] = "dtaci",
        empty: Empty = "allow",
    ) -> None:
        self._sets = Calibrator(bins, alpha, score, "none", empty)
        if isinstance(method, str):
            if method not in METHODS:
                raise ConformalError(f"method must be one of {sorted(METHODS)} or make a Tracker, got {method!r}")
            method = METHODS[method]
        self.bins = bins
        self.trackers = [method(as_alpha(alpha)) for _ in range(bins.n_targets)]

    @property
    def thresholds(self) -> npt.NDArray[np.float64]:
        """Thresholds in force, (d,)."""
        return np.array([tracker.threshold() for tracker in self.trackers])

    def predict(self, proba: Probabilities) -> Regions:
        """Regions at the thresholds in force, for one or more samples."""
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

    def _learn(self, scores: npt.NDArray[np.floating[Any]]) -> None:
        for tracker, score in zip(self.trackers, scores, strict=True):
            tracker.update(float(score))
