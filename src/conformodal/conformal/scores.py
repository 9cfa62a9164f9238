"""Nonconformity scores over bins: how strange each bin would be as the answer.

A score is one small class. It sees one target's probabilities and bin widths, and returns a score for every bin;
calibration picks the true bin's entry, prediction compares all entries with the threshold. Both go through the
same function, so membership and score agree to the last bit.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from .errors import ConformalError

FloatArray = npt.NDArray[np.floating[Any]]


class Score(Protocol):
    """What a score must offer."""

    name: str

    def of_bins(self, proba: FloatArray, widths: npt.NDArray[np.float64]) -> FloatArray:
        """Score every bin: `proba` (n, K) and `widths` (K,) in, (n, K) out, larger is stranger."""
        ...


class Lac:
    """Least ambiguous set-valued classifier, the paper's score: one minus the bin's probability.

    Source: Sadinle, Lei and Wasserman (2019); the paper, section 2.
    """

    name = "lac"

    def of_bins(self, proba: FloatArray, widths: npt.NDArray[np.float64]) -> FloatArray:
        """``1 - proba``."""
        return np.asarray(1 - proba)


class Density:
    """Minus the probability density of the bin (probability over width).

    For bins of unequal width, level sets of the density are the shortest sets of a given probability; level sets
    of the probability are not.
    """

    name = "density"

    def of_bins(self, proba: FloatArray, widths: npt.NDArray[np.float64]) -> FloatArray:
        """``-proba / widths``."""
        return np.asarray(proba * (-1 / widths).astype(proba.dtype))


SCORES: dict[str, Score] = {score.name: score for score in (Lac(), Density())}


def resolve_score(score: str | Score) -> Score:
    """Return a score object for a name from :data:`SCORES`, or the object itself.

    Raises
    ------
    ConformalError
        If the name is unknown, or the object has no ``of_bins``.
    """
    if isinstance(score, str):
        if score not in SCORES:
            raise ConformalError(f"score must be one of {sorted(SCORES)} or a Score object, got {score!r}")
        return SCORES[score]
    if not callable(getattr(score, "of_bins", None)):
        raise ConformalError(f"score must be a name or have of_bins(proba, widths), got {type(score).__name__}")
    return score
