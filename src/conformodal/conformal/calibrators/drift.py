"""Whether incoming rows are still exchangeable with the calibration samples, and since when not."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from sklearn.utils import check_random_state

from conformodal.conformal.checks import SHARE, Probabilities, as_scores, check_number
from conformodal.core.arrays import FloatArray, RealArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .split import SplitConformal

# of the bets, and the share of capital that is spread anew over them before each row (Vovk 2021: the Simple Jumper)
_SLOPES, _JUMP = np.array([-1.0, 0.0, 1.0]), 0.01


class DriftMonitor:
    """A conformal test martingale on incoming rows: an alarm says that the coverage guarantee no longer holds.

    Every row's score is ranked among those of the calibration samples and of all earlier rows. If all are exchangeable,
    the ranks are independent and uniform, and no bet on them gains: the capital ever exceeds ``1 / delta`` with
    probability at most `delta`, however long the stream (Ville's inequality). After an alarm, calibrate on rows from
    :attr:`since` on, learn anew, or follow the stream with :class:`~conformodal.conformal.OnlineConformal`.

    Source: Vovk (2021), "Testing randomness online".

    Parameters
    ----------
    calibrator
        Calibrated, without units. Its targets' capitals are averaged.
    delta
        Probability of a false alarm, in (0, 1).
    random_state
        Seed of the numbers that break ties.

    Attributes
    ----------
    p_values : list of arrays, one per row: ranks as shares, one per target, or one for all with ``joint="max"``
    alarm : row, from 0, at which the capital first reached ``1 / delta``, or None

    Printed, it says for example ``capital 8.4e+09: alarm at row 1062, change since about row 1004; coverage since then
    0.58``; for code see ``docs/howto/groups-and-shift.md``.
    """

    def __init__(self, calibrator: SplitConformal, delta: float = 0.01, random_state: Any = None) -> None:
        if not isinstance(calibrator, SplitConformal) or getattr(calibrator, "units_", None) is not None:
            raise ConformodalError("calibrator must be a SplitConformal without units")
        self.calibrator = calibrator
        self.delta = check_number(delta, "delta", SHARE)
        self._random = check_random_state(random_state)
        calibration = calibrator.columns(calibrator._calibrated())
        self._past = [np.sort(column).tolist() for column in calibration.T]
        self._shares = np.full((calibration.shape[1], _SLOPES.size), 1 / _SLOPES.size)
        self._logs = np.zeros(calibration.shape[1])
        self.p_values: list[FloatArray] = []
        self._log = 0.0
        self._rows: list[RealArray] = [np.empty((0, calibrator.bins.n_targets))]
        self.alarm: int | None = None

    def update(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Learn the truth of rows, in their order; `proba` is (n, d, K) or a list of d arrays (n, K_d)."""
        return self.update_scores(self.calibrator.score_samples(proba, y))

    def update_scores(self, scores: RealArray) -> Self:
        """Learn the scores (n, d) of rows."""
        scores = as_scores(scores)
        for row in self.calibrator.columns(scores):
            p_values = np.empty(row.size)
            for j, score in enumerate(row.tolist()):
                past, share = self._past[j], self._random.random_sample()
                low, high = bisect_left(past, score), bisect_right(past, score)
                p_values[j] = p = (len(past) - high + share * (high - low + 1)) / (len(past) + 1)
                past.insert(high, score)
                bets = ((1 - _JUMP) * self._shares[j] + _JUMP / _SLOPES.size) * (1 + _SLOPES * (p - 0.5))
                self._logs[j] += np.log(bets.sum())
                self._shares[j] = bets / bets.sum()
            self.p_values.append(p_values)
            # not their mean: each is a martingale given its own target's past, not given that of all targets
            self._log = float(self._logs.max() - np.log(self._logs.size))
            if self.alarm is None and self._log >= -np.log(self.delta):
                self.alarm = len(self.p_values) - 1
        self._rows.append(scores)
        return self

    @property
    def capital(self) -> float:
        """The martingale after the last row, 1 at the start."""
        with np.errstate(over="ignore"):
            return float(np.exp(self._log))

    @property
    def since(self) -> int | None:
        """First row of the change, as estimated: from it on, up to the alarm, a fixed bet would have gained most."""
        if self.alarm is None:
            return None
        p = np.array(self.p_values[: self.alarm + 1])
        gains = [np.log1p(slope * (column - 0.5)) for slope in (-1, 1) for column in p.T]
        paths = np.cumsum(np.pad(gains, ((0, 0), (1, 0))), axis=1)
        best = paths[(paths[:, -1] - paths.min(axis=1)).argmax()]
        return int(best.argmin())

    @property
    def coverage_since(self) -> FloatArray | None:
        """Share (d,) of the rows from the change on whose value is in its set, or None before an alarm."""
        if self.since is None:
            return None
        return np.asarray((np.concatenate(self._rows)[self.since :] <= self.calibrator.thresholds_).mean(axis=0))

    def __str__(self) -> str:
        if self.coverage_since is None:
            return f"capital {self.capital:.2g}: no alarm in {counted(len(self.p_values), 'row')}"
        covered = ", ".join(f"{share:.2f}" for share in self.coverage_since)
        where = f"alarm at row {self.alarm}, change since about row {self.since}"
        return f"capital {self.capital:.2g}: {where}; coverage since then {covered}"
