"""Online conformal prediction for sequences that drift: trackers turn a stream of scores into thresholds.

Trackers: adaptive conformal inference and conformal PID control.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from math import ceil, inf, isnan, pi, sqrt, tan
from numbers import Real
from sys import float_info
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, brief, check_number
from conformodal.conformal.regions import Regions
from conformodal.conformal.scores import Score
from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .base import Calibrator, Empty

# a quarter of the largest float, so that sums of forecast, tracked and integral stay finite
_MOST = float_info.max / 4
# strength of the integral of ConformalPid, as a share of the scores' range
_INTEGRAL_GAIN = 0.1
_POSITIVE = Range(0, ends="(]")


class PastScores:
    """Scores seen so far, or the last `window` of them."""

    def __init__(self, window: int | None = None) -> None:
        self.window = None if window is None else check_number(window, "window", Range(1, whole=True))
        self._order: deque[float] = deque()
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, score: float) -> None:
        """Add a score; the oldest one beyond the window is dropped."""
        insort(self._sorted, score)
        self._order.append(score)
        if self.window is not None and len(self._order) > self.window:
            del self._sorted[bisect_left(self._sorted, self._order.popleft())]

    def threshold(self, alpha: Fraction | float) -> float:
        """The score of rank ``ceil((n + 1)(1 - alpha))``, exactly: ``inf`` beyond n, ``-inf`` below 1."""
        k = ceil((len(self) + 1) * (1 - Fraction(alpha)))
        if k > len(self):
            return inf
        return self._sorted[k - 1] if k >= 1 else -inf

    def spread(self) -> float:
        """Largest less smallest finite score, at most the largest float; 1 if there is none."""
        finite = bisect_left(self._sorted, inf)
        low = bisect_left(self._sorted, -inf)
        width = self._sorted[finite - 1] - self._sorted[low] if finite > low else 0.0
        return min(width, float_info.max) if width > 0 else 1.0


def _as_score(score: float) -> float:
    if not isinstance(score, Real) or isnan(score):
        raise ConformodalError(f"score must be a number (what cannot be scored scores +inf), got {brief(score)}")
    return float(score)


class Aci:
    """Adaptive conformal inference on a stream of scores (Gibbs and Candes 2021); see :class:`OnlineConformal`.

    After every score ``alpha_t`` moves by ``gamma (alpha - missed)``. For any sequence, even an adversarial one, the
    share of misses over T steps differs from alpha by at most ``(max(alpha, 1 - alpha) + gamma) / (T gamma)`` (there,
    proposition 4.1). For this, the threshold is ``+inf`` (unbounded) if ``alpha_t`` is below 0, and ``-inf`` (the empty
    set, which misses every score, ``-inf`` too) from 1 on. Nothing is guaranteed about the size of the sets or any part
    of the sequence.

    Parameters
    ----------
    alpha, gamma
        Miscoverage rate in (0, 1), and the step of alpha.
    window
        Past scores to rank among; None for all: memory and time per step then grow with the stream, by about 40 bytes
        per score and, beyond a million scores, a millisecond per step. The bound holds for any window.
    """

    def __init__(self, alpha: Alpha = 0.1, gamma: float = 0.005, window: int | None = None) -> None:
        self.alpha = as_alpha(alpha)
        self.gamma = Fraction(str(check_number(gamma, "gamma", _POSITIVE)))
        self.alpha_t = self.alpha  # the current rate; may leave [0, 1]
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        return self.past.threshold(self.alpha_t)

    def update(self, score: float) -> None:
        """Learn the score."""
        value = _as_score(score)
        missed = value > self.threshold() or self.alpha_t >= 1  # the empty set misses -inf too
        self.alpha_t += self.gamma * (self.alpha - int(missed))
        self.past.add(value)


class ConformalPid:
    """Conformal PID control (Angelopoulos, Candes and Tibshirani 2023); see :class:`OnlineConformal`.

    It tracks a quantile (P) and integrates the error (I); the source's forecast (D) is left out.

    The threshold is ``tracked + integral``. `tracked` moves by ``rate * spread * (missed - alpha)`` after
    every score, `spread` being the range of the last `window` scores. The integral is
    ``0.1 spread tan(E / (saturation sqrt(t)))``, E the sum of ``missed - alpha`` over t scores; where its
    argument leaves (-pi/2, pi/2) it is infinite, and the set unbounded, or empty (it then misses every score).

    For any sequence, the share of misses over T steps differs from alpha by at most
    ``(pi/2 saturation sqrt(T) + 1) / T``. This is the source's theorem 1 with the saturation ``h(t) = sqrt(t)``; as the
    integral saturates at infinity, scores may be unbounded.

    Parameters
    ----------
    alpha
        Miscoverage rate in (0, 1).
    rate
        Step of the quantile tracker, as a share of the scores' range.
    saturation
        The larger, the later the integral saturates and the larger the bound.
    window
        Scores whose range sets the steps; None for all: memory then grows with the stream.
    """

    def __init__(
        self, alpha: Alpha = 0.1, rate: float = 0.1, saturation: float = 1.0, window: int | None = 100
    ) -> None:
        self.alpha = as_alpha(alpha)
        self.rate = float(check_number(rate, "rate", _POSITIVE))
        self.saturation = float(check_number(saturation, "saturation", _POSITIVE))
        self.tracked: float | None = None  # before the first score sets are unbounded
        self.error = 0 * self.alpha
        self.steps = 0
        self.past = PastScores(window)

    def threshold(self) -> float:
        """Threshold for the next score."""
        if self.tracked is None:
            return inf
        angle = float(self.error) / sqrt(self.steps) / self.saturation
        if abs(angle) >= pi / 2:
            return inf if angle > 0 else -inf
        return _clipped(self.tracked + _clipped(_INTEGRAL_GAIN * self.past.spread() * tan(angle)))

    def update(self, score: float) -> None:
        """Learn the score."""
        value = _as_score(score)
        limit = self.threshold()
        missed = int(value > limit or limit == -inf)  # the empty set misses -inf too
        self.past.add(value)
        if self.tracked is None:
            self.tracked = value if abs(value) < inf else 0.0
        self.error += missed - self.alpha
        self.tracked = _clipped(self.tracked + self.rate * self.past.spread() * float(missed - self.alpha))
        self.steps += 1


def _clipped(value: float) -> float:
    return min(max(value, -_MOST), _MOST)


METHODS: dict[str, Callable[[Alpha], Any]] = {"aci": Aci, "pid": ConformalPid}


class OnlineConformal:
    """Regions for a sequence: predict, see the truth, update.

    For any sequence, the share of misses of a target over T samples differs from alpha by at most

    - ``(max(alpha, 1 - alpha) + 0.005) / (0.005 T)`` with ``"aci"`` (:class:`Aci`),
    - ``(pi/2 sqrt(T) + 1) / T`` with ``"pid"`` (:class:`ConformalPid`).

    Nothing is guaranteed for a single sample, or for the size of sets: against an adversary most are unbounded. For an
    example see ``docs/howto/groups-and-shift.md``.

    Parameters
    ----------
    bins, alpha, score
        As in :class:`~conformodal.conformal.calibrators.base.Calibrator`; the rate is per target.
    method
        ``"aci"`` or ``"pid"`` with their defaults, or a function that makes a tracker from alpha: an object with
        ``threshold()``, ``inf`` for an unbounded set and ``-inf`` for the empty one, and ``update(score)``. ``"aci"``
        stores all past scores, about 40 bytes per sample and target; ``lambda alpha: Aci(alpha, window=1000)`` stores
        the last thousand and has the same bound.
    empty
        ``"allow"`` or ``"mode"``, as for the other calibrators. With ``"mode"`` a threshold of ``-inf`` shows one bin,
        but still counts as a miss.
    """

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        method: str | Callable[[Alpha], Any] = "aci",
        empty: Empty = "allow",
    ) -> None:
        self._sets = Calibrator(bins, alpha, score, "none", empty)
        self._sets.check_parameters()
        make = METHODS.get(method) if isinstance(method, str) else method
        if not callable(make):
            raise ConformodalError(f"method must be one of {sorted(METHODS)} or a function, got {brief(method)}")
        self.bins = bins
        self.trackers = [make(as_alpha(alpha)) for _ in range(bins.n_targets)]

    @property
    def thresholds(self) -> FloatArray:
        """Current thresholds, (d,)."""
        return np.array([tracker.threshold() for tracker in self.trackers], dtype=np.float64)

    def predict(self, proba: Probabilities) -> Regions:
        """Regions of one or more samples at the current thresholds."""
        return self._sets.regions_at(proba, self.thresholds)

    def update(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Learn the truth of samples, in the order of their rows."""
        self._limits(proba, y)
        return self

    def run(self, proba: Probabilities, y: npt.ArrayLike) -> Regions:
        """Predict and update, row by row: the regions each sample had before its truth was known."""
        return self._sets.regions_at(proba, self._limits(proba, y))

    def _limits(self, proba: Probabilities, y: npt.ArrayLike) -> FloatArray:
        """Thresholds (n, d) before each row, whose truth is then learnt."""
        scores = self._sets.score_samples(proba, y)
        limits = np.empty(scores.shape)
        for limit, row in zip(limits, scores, strict=True):
            limit[:] = self.thresholds
            for tracker, score in zip(self.trackers, row, strict=True):
                tracker.update(float(score))
        return limits
