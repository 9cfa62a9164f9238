"""The score of a regressor, chosen on training rows that the densities were not learnt from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray, RealArray

from .checks import Alpha, as_alpha
from .rank import conformal_quantile
from .scores import Density, Interval, ScaledDensity, Score, deviations

# of one target: probabilities (m, K) of rows by densities that have not learnt from them, and the bins of their values
LeftOut: TypeAlias = tuple[RealArray, IntArray]

_POWERS = (0.0, 0.25, 0.5, 0.75, 1.0)
# the quarter of rows with the largest standard deviations must miss at most this times alpha
_MAX_MISSED = 0.8
# sets that are longer by this factor are as long: one interval is then easier to read
_AS_LONG = 1.01
# rows below which a quarter says little, and that are enough
_FEWEST_ROWS, _MOST_ROWS = 100, 5000


class _JudgedScore(NamedTuple):
    """A score, the logarithm of the mean size of its sets, and coverage of the rows with the widest distributions."""

    score: Score
    log_size: float
    covered: float


def choose_score(left_out: Sequence[LeftOut], widths: Sequence[FloatArray], alpha: Alpha) -> Score:
    """A density scaled by a power of its entropy, or one interval where its sets are no longer.

    The power is that with the smallest sets of those that cover the rows with the widest distributions; if none does,
    that which covers most of them. One interval is taken where it covers them as often, and its sets are longer by 1 %
    at most. `left_out` and the `widths` of the bins are of the targets, over which sizes and coverages are averaged.
    The choice depends on training rows alone, so that calibration is as valid as with any fixed score.
    """
    if min(len(codes) for _, codes in left_out) < _FEWEST_ROWS:
        return Density()
    some = [(proba[:_MOST_ROWS], codes[:_MOST_ROWS]) for proba, codes in left_out]
    scaled = [_judge(ScaledDensity(power) if power else Density(), some, widths, alpha) for power in _POWERS]
    needed = 1 - _MAX_MISSED * float(as_alpha(alpha))
    enough = [one for one in scaled if one.covered >= needed] or [max(scaled, key=lambda one: one.covered)]
    best = min(enough, key=lambda one: one.log_size)
    interval = _judge(Interval(), some, widths, alpha)
    as_good = interval.covered >= min(needed, best.covered) and interval.log_size <= best.log_size + np.log(_AS_LONG)
    return interval.score if as_good else best.score


def _judge(score: Score, left_out: list[LeftOut], widths: Sequence[FloatArray], alpha: Alpha) -> _JudgedScore:
    sizes, covered = [], []
    for (proba, codes), each in zip(left_out, widths, strict=True):
        scores = score.of_bins(proba, each)
        own = scores[np.arange(codes.size), codes]
        threshold = conformal_quantile(own, alpha)
        _, spread = deviations(proba, each)
        sizes.append(float(((scores <= threshold) @ each).mean()))
        covered.append(float((own <= threshold)[spread >= np.quantile(spread, 0.75)].mean()))
    return _JudgedScore(
        score, float(np.log(np.maximum(sizes, np.finfo(np.float64).tiny)).mean()), float(np.mean(covered))
    )
