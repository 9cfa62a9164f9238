"""Adaptive conformal inference: alpha itself follows the misses, and is never clipped."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import log, sqrt

import numpy as np

from ..checks import Alpha, as_alpha
from ..errors import ConformalError
from .past import PastScores, as_score


class Aci:
    """Adaptive conformal inference on a stream of scores (Gibbs and Candes 2021).

    After every score ``alpha_t`` moves by ``gamma (alpha - missed)``. Whatever the sequence, the share of misses over
    T steps differs from alpha by at most ``(max(alpha, 1 - alpha) + gamma) / (T gamma)``. Below 0 the threshold is
    ``+inf`` (the whole space), from 1 on ``-inf`` (the empty set): without both, the bound does not hold.

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    gamma
        Step of alpha, above 0.
    window
        Past scores to rank among; None for all.

    Attributes
    ----------
    alpha_t : Fraction
        The rate in force, exact; may lie outside [0, 1].
    """

    def __init__(self, alpha: Alpha = 0.1, gamma: float = 0.005, window: int | None = None) -> None:
        self.alpha = as_alpha(alpha)
        if not 0 < gamma < float("inf"):
            raise ConformalError(f"gamma must be above 0, got {gamma}")
        self.gamma = Fraction(str(gamma))
        self.alpha_t = self.alpha
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        return self.past.threshold(self.alpha_t)

    def update(self, score: float) -> None:
        """Learn the score that came."""
        value = as_score(score)
        self.alpha_t += self.gamma * (self.alpha - int(value > self.threshold()))
        self.past.add(value)


class DtAci:
    """Dynamically tuned ACI: experts with different steps, weighted by how well they did (Gibbs and Candes 2024).

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    gammas
        Steps of the experts.
    interval
        Length of the stretches over which regret is kept low, in scores; sets the learning rates as in the source,
        section 3.
    window
        Past scores to rank among; None for all.
    """

    def __init__(
        self,
        alpha: Alpha = 0.1,
        gammas: Sequence[float] = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128),
        interval: int = 500,
        window: int | None = None,
    ) -> None:
        if not gammas or not all(g > 0 for g in gammas):
            raise ConformalError(f"gammas must be steps above 0, at least one, got {gammas!r}")
        if interval < 1:
            raise ConformalError(f"interval must be at least 1, got {interval}")
        self.alpha = as_alpha(alpha)
        a, k = float(self.alpha), len(gammas)
        self.gammas = np.asarray(gammas, dtype=np.float64)
        self.experts = np.full(k, a)
        self.weights = np.full(k, 1 / k)
        self.forget = 1 / (2 * interval)
        spread = (1 - a) ** 2 * a**3 + a**2 * (1 - a) ** 3
        self.rate = sqrt(3 / interval) * sqrt((log(k * interval) + 2) / spread)
        self.past = PastScores(window)

    @property
    def alpha_t(self) -> float:
        """The rate in force, the experts' weighted mean; may lie outside [0, 1]."""
        return float(self.weights @ self.experts)

    def threshold(self) -> float:
        """Threshold for the next score."""
        return self.past.threshold(self.alpha_t)

    def update(self, score: float) -> None:
        """Learn the score that came."""
        value = as_score(score)
        beta = self.past.p_value(value)
        a = float(self.alpha)
        loss = a * (beta - self.experts) - np.minimum(0.0, beta - self.experts)
        scaled = self.weights * np.exp(-self.rate * (loss - loss.min()))
        scaled /= scaled.sum()
        self.weights = (1 - self.forget) * scaled + self.forget / scaled.size
        self.experts = self.experts + self.gammas * (a - (self.experts >= beta))
        self.past.add(value)
