"""The past scores of a sequence, kept in order."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from fractions import Fraction
from math import ceil, inf
from sys import float_info

from conformodal.conformal.scalars import as_count, as_number


class PastScores:
    """Scores seen so far, or the last `window` of them.

    Parameters
    ----------
    window
        How many to keep; None keeps all, so that memory and the time of a step grow with the stream: about 40 bytes a
        score and, beyond a million scores, about a millisecond a step.
    """

    def __init__(self, window: int | None = None) -> None:
        if window is not None:
            window = as_count(window, "window, in scores or None for all,", 1)
        self._order: deque[float] = deque()
        self._sorted: list[float] = []
        self.window = window

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, score: float) -> None:
        """Remember a score; the oldest one beyond the window is forgotten."""
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
        """Largest less smallest finite score, at most the largest float; 1 where there is none."""
        finite = bisect_left(self._sorted, inf)
        low = bisect_left(self._sorted, -inf)
        width = self._sorted[finite - 1] - self._sorted[low] if finite > low else 0.0
        return min(width, float_info.max) if width > 0 else 1.0


def as_score(score: float) -> float:
    """Return a score as a float."""
    if type(score) is float and score == score:  # noqa: PLR0124 - not NaN
        return score
    return as_number(score, "score", "a number and not NaN (what cannot be scored scores +inf)", lambda s: s == s)  # noqa: PLR0124
