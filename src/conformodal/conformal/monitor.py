"""Monitoring a deployed model: a bet against exchangeability that grows when new scores are unlike those before.

A smoothed conformal p-value ranks each new score among those before it. If all scores are exchangeable, the p-values
are independent and uniform (Vovk, Gammerman and Shafer 2005, theorem 8.2), so the capital of whoever bets on them is a
martingale. By Ville's inequality it ever reaches 1 / level with probability at most the level.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, FloatArray, rows_by_label
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range

from .checks import SHARE, Alpha, as_alpha, as_labels, as_scores, check_number

# Slopes of the bets, and the shares of the capital that move between them at each step. With slopes of at most 1, as in
# the paper, 30 units after 20 rarely suffice for an alarm: chosen on simulated shifts with seeds 10 to 11
_SLOPES = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
_JUMPS = np.array([1e-4, 1e-3, 1e-2, 1e-1, 1.0])
_SEED = Range(0, whole=True)


class ExchangeabilityMartingale:
    """A test of whether new scores are exchangeable with those before, valid at any time at which it is looked at.

    The bet is the composite jumper (Vovk, Petej, Nouretdinov, Ahlberg, Carlsson and Gammerman 2021, "Retrain or not
    retrain: conformal test martingales for change-point detection", algorithm 1): capital is spread over bets
    ``1 + slope (p - 1/2)``, and a share of it moves between these at each step, so that it follows changes whenever and
    in whichever direction they occur. It needs no knowledge of the shift.

    Parameters
    ----------
    scores
        (n,) nonconformity scores before, such as those that calibrate; in any order. ``+inf`` is the worst.
    groups
        (n,) labels, if scores are exchangeable within groups only: each score is ranked within its own.
    level
        Probability of an alarm while scores are exchangeable, at most, however long it is watched.
    larger_only
        Bet on larger scores alone, those that a region misses. Then smaller ones, as those of a better model, raise no
        alarm.
    seed
        Of the random numbers that break ties: the same scores give the same values.

    Attributes
    ----------
    p_values_ : (m,) of the new scores; small where a score is larger than those before
    values_ : (m,) capital after each, from 1 at the start, at most 1e300
    alarm_ : index of the first new score at which the capital is ``1 / level`` or more; None without an alarm
    larger_ : whether the scores up to the alarm, or up to now, tend to be larger than those before

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> monitor = ExchangeabilityMartingale(rng.normal(size=200))
    >>> monitor.update(rng.normal(size=100)).alarm_ is None
    True
    >>> monitor.update(rng.normal(1, 1, size=100)).alarm_
    134
    """

    def __init__(
        self,
        scores: npt.ArrayLike = (),
        groups: npt.ArrayLike | None = None,
        level: float = 0.01,
        *,
        larger_only: bool = False,
        seed: int = 0,
    ) -> None:
        self.level = float(check_number(level, "level", SHARE))
        self._random = np.random.default_rng(check_number(seed, "seed", _SEED))
        self._ranked: dict[Any, list[float]] = {}
        self._grouped = groups is not None
        self._slopes = _SLOPES[_SLOPES <= 0] if larger_only else _SLOPES
        self._capital = np.full((len(_JUMPS), len(self._slopes)), 1 / len(self._slopes))
        self._log = 0.0  # of the factor that the capital was divided by
        self.p_values_ = self.values_ = np.empty(0)
        self.alarm_: int | None = None
        self.larger_ = False
        before = _vector(scores)
        for label, score in zip(self._labels(groups, len(before)), before.tolist(), strict=True):
            self._ranked.setdefault(label, []).append(score)
        for ranked in self._ranked.values():
            ranked.sort()

    def update(self, scores: npt.ArrayLike, groups: npt.ArrayLike | None = None) -> Self:
        """Bet on new scores (m,), in the order in which they came; each joins those that the next is ranked among."""
        new, values = _vector(scores), []
        labels = self._labels(groups, len(new))
        ties = self._random.random(len(new))
        p_values = np.array([self._p_value(*one) for one in zip(labels, new.tolist(), ties.tolist(), strict=True)])
        for number, p in enumerate(p_values.tolist(), start=len(self.values_)):
            values.append(self._bet(p))
            if self.alarm_ is None:
                on_larger, on_smaller = (self._capital[:, side].sum() for side in (self._slopes < 0, self._slopes > 0))
                self.larger_ = bool(on_larger > on_smaller)
                if values[-1] >= 1 / self.level:
                    self.alarm_ = number
        self.p_values_ = np.concatenate((self.p_values_, p_values))
        self.values_ = np.concatenate((self.values_, values))
        return self

    def _labels(self, groups: npt.ArrayLike | None, n: int) -> list[Any]:
        if (groups is not None) != self._grouped:
            raise ConformodalError(f"groups {'are needed' if self._grouped else 'must be None'}, as at the start")
        return [None] * n if groups is None else as_labels(groups, n).tolist()

    def _p_value(self, label: Any, score: float, tie: float) -> float:
        """The share of the scores until now, this one among them, that are larger, and a random part of equal ones."""
        ranked = self._ranked.setdefault(label, [])
        first, past = bisect_left(ranked, score), bisect_right(ranked, score)
        larger, equal = len(ranked) - past, past - first + 1
        insort(ranked, score)
        return (larger + tie * equal) / len(ranked)

    def _bet(self, p: float) -> float:
        """The capital after a p-value."""
        moved = _JUMPS[:, None] * self._capital.sum(axis=1, keepdims=True) / len(self._slopes)
        self._capital = ((1 - _JUMPS[:, None]) * self._capital + moved) * (1 + self._slopes * (p - 0.5))
        capital = float(self._capital.sum(axis=1).mean())
        self._capital /= capital
        self._log += math.log(capital)
        return math.exp(min(self._log, 300 * math.log(10)))


def unit_scores(scores: npt.ArrayLike, units: npt.ArrayLike, alpha: Alpha) -> tuple[AnyArray, FloatArray]:
    """The labels (k,), sorted, and one score (k,) per unit: the threshold that covers 1 - alpha of its own samples.

    It is a function of the unit's scores (n,) alone, whatever their order: units that are exchangeable have
    exchangeable scores, however dependent their samples are.
    """
    values, rate = _vector(scores), as_alpha(alpha)
    labels = as_labels(units, len(values), "units")
    rows = rows_by_label(labels)
    # the smallest score that a share of 1 - alpha does not exceed, in whole numbers
    ranks = [-(len(members) * (rate.numerator - rate.denominator) // rate.denominator) for members in rows]
    chosen = [np.partition(values[members], k - 1)[k - 1] for members, k in zip(rows, ranks, strict=True)]
    return np.unique(labels), np.array(chosen, dtype=np.float64)


def _vector(scores: npt.ArrayLike) -> FloatArray:
    values = as_scores(scores).astype(np.float64)
    if values.ndim != 1:
        raise ConformodalError(f"scores must be a vector, got shape {values.shape}")
    return values
