"""Online conformal prediction for sequences that drift: a tracker turns a stream of scores into thresholds."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from fractions import Fraction
from math import ceil, inf, isnan
from numbers import Real
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.checks import Alpha, Probabilities, as_alpha, brief, check_number
from conformodal.conformal.regions import Regions
from conformodal.conformal.scores import Score
from conformodal.conformal.streams import ScoreSource, ScoreStream
from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .base import Calibrator, Empty

_POSITIVE = Range(0, ends="(]")


class PastScores:
    """Scores seen so far, or the last `window` of them."""

    def __init__(self, window: int | None = None) -> None:
        self.window = None if window is None else check_number(window, "window", Range(1, whole=True))
        self._order: deque[float] = deque()
        self._sorted: list[float] = []
        self._stream: ScoreStream | None = None
        self._column = 0

    def begin(self, stream: ScoreStream, column: int) -> None:
        """Put the scores of a stream before those seen: the last ones of a window, or all, which are not copied."""
        if self.window is None:
            self._stream, self._column = stream, column
            return
        past: deque[float] = deque(maxlen=self.window)
        for chunk in stream.chunks():
            past.extend(chunk[:, column].tolist())
        seen = [*self._order]
        self._order, self._sorted = deque(), []
        for score in [*past, *seen][-self.window :]:
            self.add(score)

    def __len__(self) -> int:
        return len(self._sorted) + (0 if self._stream is None else len(self._stream))

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
        if k >= 1 and self._stream is not None:
            return self._stream.smallest(k, self._column, self._sorted)
        return self._sorted[k - 1] if k >= 1 else -inf


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


class OnlineConformal:
    """Regions for a sequence: predict, see the truth, update.

    For any sequence, the share of misses of a target over T samples differs from alpha by at most
    ``(max(alpha, 1 - alpha) + gamma) / (gamma T)``, see :class:`Aci`. Nothing is guaranteed for a single sample, or for
    the size of sets: against an adversary most are unbounded. For an example see ``docs/howto/groups-and-shift.md``.

    Parameters
    ----------
    bins, alpha, score
        As in :class:`~conformodal.conformal.calibrators.base.Calibrator`; the rate is per target.
    gamma, window
        As in :class:`Aci`, of each target.
    empty
        ``"allow"`` or ``"mode"``, as for the other calibrators. With ``"mode"`` a threshold of ``-inf`` shows one bin,
        but still counts as a miss.
    """

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        gamma: float = 0.005,
        window: int | None = None,
        empty: Empty = "allow",
    ) -> None:
        self._sets = Calibrator(bins, alpha, score, "none", empty)
        self._sets.check_parameters()
        self.bins = bins
        self.trackers = [Aci(alpha, gamma, window) for _ in range(bins.n_targets)]

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

    def begin(self, scores: ScoreSource) -> Self:
        """Rank new samples among earlier scores too, (n, d), of which more may be than memory holds; before any update.

        They come from a source, see :class:`~conformodal.conformal.streams.ScoreStream`. With a `window`, its last
        scores are kept. Without one all count, exactly: for a new rate the source is read up to three times,
        which takes seconds for a hundred million scores.
        """
        stream = ScoreStream(scores)
        if stream.shape[1] != len(self.trackers):
            raise ConformodalError(f"scores must have shape (n, {len(self.trackers)}), got {stream.shape}")
        for j, tracker in enumerate(self.trackers):
            tracker.past.begin(stream, j)
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
