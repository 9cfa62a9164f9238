"""Adaptive conformal inference: alpha itself follows the misses, and is never clipped."""

from __future__ import annotations

from fractions import Fraction
from math import inf

from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.conformal.scalars import as_number

from .past import PastScores, as_score


class Aci:
    """Adaptive conformal inference on a stream of scores (Gibbs and Candes 2021).

    After every score ``alpha_t`` moves by ``gamma (alpha - missed)``. Whatever the sequence, be it chosen by someone
    who knows the thresholds, the share of misses over T steps differs from alpha by at most
    ``(max(alpha, 1 - alpha) + gamma) / (T gamma)`` (there, proposition 4.1). Below 0 the threshold is ``+inf`` (the
    whole space), from 1 on ``-inf`` (the empty set, which misses every score, ``-inf`` too): without both, the bound
    does not hold. It says nothing about the sets' sizes, nor about any stretch of the sequence: against scores just
    above the threshold, nine sets in ten are unbounded at alpha = 0.1.

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
