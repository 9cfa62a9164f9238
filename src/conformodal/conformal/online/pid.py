"""Conformal PID control: the threshold itself is steered (Angelopoulos, Candes and Tibshirani 2023)."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, pi, sqrt, tan
from sys import float_info

from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.conformal.errors import ConformalError
from conformodal.conformal.scalars import as_number, brief

from .past import PastScores, as_score

Scorecaster = Callable[[int], float]


class ConformalPid:
    """Quantile tracking (P), error integration (I) and an optional forecast of the scores (D).

    The threshold is ``forecast + tracked + integral``. `tracked` moves by ``rate * spread * (missed - alpha)`` after
    every score, `spread` being the range of the last `window` scores. The integral is
    ``integral_gain * spread * tan(E / (saturation sqrt(t)))``, E the sum of ``missed - alpha`` over t scores; where its
    argument leaves (-pi/2, pi/2) it is infinite, and the set unbounded, or empty (it then misses every score).

    Whatever the sequence, and whatever is forecast, the share of misses over T steps therefore differs from alpha by at
    most ``(pi/2 saturation sqrt(T) + 1) / T``. This is the source's theorem 1 with the saturation at
    ``h(t) = sqrt(t)``; as the integral saturates at infinity, scores need no bounds. The source's examples saturate at
    ``t / log(t)`` times a constant, where the bound is above any useful value for millions of steps. Without the
    integral (``integral_gain=0``) nothing is guaranteed: the source's bound for the quantile tracker alone needs scores
    within known bounds and a fixed step, and the step here follows the scores.

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    rate
        Step of the quantile tracker, as a share of the scores' range.
    integral_gain
        Strength of the integral, as a share of the scores' range; 0 turns it off, and the bound with it.
    saturation
        The larger, the later the integral saturates, and the larger the bound.
    window
        Scores whose range sets the steps; None for all: memory then grows with the stream.
    start
        Threshold before the first score; None waits with unbounded sets until one has come.
    forecast
        Called with the number of scores so far, gives a forecast of the next score's quantile, a finite number.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import ConformalPid
    >>> tracker, missed = ConformalPid(alpha=0.1), []
    >>> for score in np.random.default_rng(0).normal(np.linspace(0, 5, 1000)):  # drifts
    ...     missed.append(score > tracker.threshold())
    ...     tracker.update(score)
    >>> bool(abs(np.mean(missed) - 0.1) <= (np.pi / 2 * np.sqrt(1000) + 1) / 1000)
    True
    """

    def __init__(
        self,
        alpha: Alpha = 0.1,
        rate: float = 0.1,
        integral_gain: float = 0.1,
        saturation: float = 1.0,
        window: int | None = 100,
        start: float | None = None,
        forecast: Scorecaster | None = None,
    ) -> None:
        for name, value in (("rate", rate), ("saturation", saturation)):
            as_number(value, name, "above 0, and finite", lambda v: 0 < v < inf)
        as_number(integral_gain, "integral_gain", "at least 0, and finite", lambda v: 0 <= v < inf)
        if forecast is not None and not callable(forecast):
            raise ConformalError(f"forecast must be a function of the number of scores, got {brief(forecast)}")
        self.alpha = as_alpha(alpha)
        self.rate = float(rate)
        self.integral_gain = float(integral_gain)
        self.saturation = float(saturation)
        self.forecast = forecast
        self.tracked = None if start is None else as_number(start, "start", "finite", _is_finite)
        self.error = 0 * self.alpha
        self.steps = 0
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        if self.tracked is None:
            return inf
        integral = self._integral()
        return integral if abs(integral) == inf else _clipped(self._ahead() + self.tracked + integral)

    def update(self, score: float) -> None:
        """Learn the score that came."""
        value = as_score(score)
        ahead, limit = self._ahead(), self.threshold()
        missed = int(value > limit or limit == -inf)  # the empty set misses -inf too
        self.past.add(value)
        if self.tracked is None:
            self.tracked = value - ahead if abs(value) < inf else 0.0
        self.error += missed - self.alpha
        self.tracked = _clipped(self.tracked + self.rate * self.past.spread() * float(missed - self.alpha))
        self.steps += 1

    def _ahead(self) -> float:
        if self.forecast is None:
            return 0.0
        return as_number(self.forecast(self.steps), "forecast", "a finite number", _is_finite)

    def _integral(self) -> float:
        if self.integral_gain == 0 or self.steps == 0:
            return 0.0
        angle = float(self.error) / sqrt(self.steps) / self.saturation
        if abs(angle) >= pi / 2:
            return inf if angle > 0 else -inf
        return _clipped(self.integral_gain * self.past.spread() * tan(angle))


# a quarter of the largest float, so that sums of forecast, tracked and integral stay finite
_MOST = float_info.max / 4


def _is_finite(value: float) -> bool:
    return abs(value) <= _MOST


def _clipped(value: float) -> float:
    return min(max(value, -_MOST), _MOST)
