"""Conformal PID control: the threshold itself is steered (Angelopoulos, Candes and Tibshirani 2023)."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, log, pi, tan

from ..checks import Alpha, as_alpha
from ..errors import ConformalError
from .past import PastScores, as_score

Scorecaster = Callable[[int], float]


class ConformalPid:
    """Quantile tracking (P), error integration (I) and an optional forecast of the scores (D).

    The threshold is ``forecast + tracked + integral``. `tracked` moves by ``rate * spread * (missed - alpha)`` after
    every score, `spread` being the range of the last `window` scores. The integral is
    ``integral_gain * spread * tan(E log(t + 1) / (t saturation))``, E the sum of ``missed - alpha``; where its
    argument leaves (-pi/2, pi/2) it is infinite, and the set the whole space, or empty.

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    rate
        Step of the quantile tracker, as a share of the scores' range.
    integral_gain
        Strength of the integral, as a share of the scores' range; 0 turns it off.
    saturation
        The larger, the later the integral saturates.
    window
        Scores whose range sets the steps.
    start
        Threshold before the first score; None waits with the whole space until one has come.
    forecast
        Called with the number of scores so far, gives a forecast of the next score's quantile.
    """

    def __init__(
        self,
        alpha: Alpha = 0.1,
        rate: float = 0.1,
        integral_gain: float = 0.1,
        saturation: float = 5.0,
        window: int | None = 100,
        start: float | None = None,
        forecast: Scorecaster | None = None,
    ) -> None:
        for name, value in (("rate", rate), ("saturation", saturation)):
            if not 0 < value < inf:
                raise ConformalError(f"{name} must be above 0, got {value}")
        if not 0 <= integral_gain < inf:
            raise ConformalError(f"integral_gain must be at least 0, got {integral_gain}")
        self.alpha = as_alpha(alpha)
        self.rate = rate
        self.integral_gain = integral_gain
        self.saturation = saturation
        self.forecast = forecast
        self.tracked = start
        self.error = 0 * self.alpha
        self.steps = 0
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        if self.tracked is None:
            return inf
        ahead = self.forecast(self.steps) if self.forecast else 0.0
        return ahead + self.tracked + self._integral()

    def update(self, score: float) -> None:
        """Learn the score that came."""
        value = as_score(score)
        ahead = self.forecast(self.steps) if self.forecast else 0.0
        missed = int(value > self.threshold())
        self.past.add(value)
        if self.tracked is None:
            self.tracked = value - ahead if abs(value) < inf else 0.0
        self.error += missed - self.alpha
        self.tracked += self.rate * self.past.spread() * float(missed - self.alpha)
        self.steps += 1

    def _integral(self) -> float:
        if self.integral_gain == 0 or self.steps == 0:
            return 0.0
        angle = float(self.error) * log(self.steps + 1) / (self.steps * self.saturation)
        if abs(angle) >= pi / 2:
            return inf if angle > 0 else -inf
        return self.integral_gain * self.past.spread() * tan(angle)
