"""Adaptive conformal inference: alpha itself follows the misses, and is never clipped."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import inf, log, sqrt

import numpy as np

from ..checks import Alpha, as_alpha, as_finite
from ..errors import ConformalError
from ..scalars import as_count, as_number, brief
from .past import PastScores, as_score

_LONGEST = 1_000_000_000
# closer to 0 or 1 the learning rate of DtAci is out of range
_LEAST_ALPHA = 1e-12


class Aci:
    """Adaptive conformal inference on a stream of scores (Gibbs and Candes 2021).

    After every score ``alpha_t`` moves by ``gamma (alpha - missed)``. Whatever the sequence, be it chosen by someone
    who knows the thresholds, the share of misses over T steps differs from alpha by at most
    ``(max(alpha, 1 - alpha) + gamma) / (T gamma)`` (there, proposition 4.1). Below 0 the threshold is ``+inf`` (the
    whole space), from 1 on ``-inf`` (the empty set, which misses every score, ``-inf`` too): without both, the bound
    does not hold. It says nothing about the sets' sizes, nor about any stretch of the sequence: against scores just
    above the threshold, nine sets in ten are the whole space at alpha = 0.1.

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    gamma
        Step of alpha, above 0.
    window
        Past scores to rank among; None for all: memory then grows with the stream, see
        :class:`~conformodal.conformal.online.past.PastScores`. The bound holds for any window.

    Attributes
    ----------
    alpha_t : Fraction
        The rate in force, exact; may lie outside [0, 1].

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import Aci
    >>> tracker, missed = Aci(alpha=0.1, gamma=0.02), []
    >>> for score in np.random.default_rng(0).normal(np.linspace(0, 5, 1000)):  # drifts
    ...     missed.append(score > tracker.threshold())
    ...     tracker.update(score)
    >>> bool(abs(np.mean(missed) - 0.1) <= (0.9 + 0.02) / (1000 * 0.02))
    True
    """

    def __init__(self, alpha: Alpha = 0.1, gamma: float = 0.005, window: int | None = None) -> None:
        self.alpha = as_alpha(alpha)
        as_number(gamma, "gamma", "above 0, and finite", lambda step: 0 < step < inf)
        self.gamma = Fraction(str(gamma))
        self.alpha_t = self.alpha
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        return self.past.threshold(self.alpha_t)

    def update(self, score: float) -> None:
        """Learn the score that came."""
        value = as_score(score)
        missed = value > self.threshold() or self.alpha_t >= 1  # the empty set misses -inf too
        self.alpha_t += self.gamma * (self.alpha - int(missed))
        self.past.add(value)


class DtAci:
    """Dynamically tuned ACI: experts with different steps, weighted by how well they did (Gibbs and Candes 2024).

    It follows a drift faster than :class:`Aci`, and promises less. Each expert is ACI on p-values: its own misses keep
    the bound of :class:`Aci` with its step. This tracker uses the experts' weighted mean, whose misses have no such
    bound: at alpha = 0.1, scores just above its thresholds were missed 0.2 of the time, over 8000 steps. What the
    source proves is (1) that the mean's pinball loss is close to that of the best sequence of rates, over stretches of
    about `interval` scores, and (2) that the share of misses approaches alpha for another version of the method: the
    rate is drawn at random from the experts by their weights, the share is an expectation over these draws, and the
    learning rate and the weight that is shared out both fall to zero. Here the rate is the mean and both are constant,
    so (2) does not hold.

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
        Past scores to rank among; None for all: memory then grows with the stream.

    Examples
    --------
    >>> from conformodal.conformal import DtAci
    >>> tracker = DtAci(alpha=0.5)
    >>> tracker.threshold()  # nothing is known yet: the whole space
    inf
    >>> for score in (0.2, 0.4, 0.1):
    ...     tracker.update(score)
    >>> tracker.threshold()
    0.2
    """

    def __init__(
        self,
        alpha: Alpha = 0.1,
        gammas: Sequence[float] = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128),
        interval: int = 500,
        window: int | None = None,
    ) -> None:
        self.gammas = as_finite(gammas, "gammas", "(m,)")
        if self.gammas.size == 0 or not (self.gammas > 0).all():
            raise ConformalError(f"gammas must be steps above 0, at least one, got {brief(gammas)}")
        interval = as_count(interval, "interval", 1, _LONGEST)
        self.alpha = as_alpha(alpha)
        a, k = float(self.alpha), self.gammas.size
        if not _LEAST_ALPHA <= a <= 1 - _LEAST_ALPHA:
            raise ConformalError(f"alpha must be at least {_LEAST_ALPHA} away from 0 and 1 here, got {brief(alpha)}")
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
