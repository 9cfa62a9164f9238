"""A conformal test of novelty: whether a new sample is like the reference samples."""

from __future__ import annotations

from copy import copy
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, FloatArray, rows_by_label
from conformodal.core.errors import ConformodalError

from .checks import as_finite, as_labels, as_scores, factorise

_ROWS = 256


class NoveltyTest:
    """Conformal p-values of "this sample comes from the distribution of the reference samples".

    The novelty score of a sample is its distance to the nearest reference sample of another unit. If the units and
    the unit of a new sample are exchangeable, and the new sample is drawn at random from its unit, then
    ``P(p <= u) <= u`` for every u, and no data are held out. The full conformal test (Vovk, Gammerman and Shafer 2005;
    for units Dunn, Wasserman and Ramdas 2023) adds the new unit to the references, which can only reduce the
    distances of reference samples. So this p-value is never smaller than that of the full test.

    Parameters
    ----------
    references
        (n, k) reference samples, as descriptors that were not learnt from them.
    units
        (n,) labels of dependent samples, such as neighbouring frames of a video.

    Attributes
    ----------
    scores_, weights_ : (n,) scores of the reference samples; one over the size of each sample's unit
    n_units : number of units, K; no p-value is smaller than ``1 / (K + 1)``

    Examples
    --------
    >>> import numpy as np
    >>> test = NoveltyTest(np.arange(9.0)[:, None], np.arange(9))
    >>> test.p_values(test.scores(np.array([[4.5], [20.0]])))
    array([1. , 0.1])
    """

    def __init__(self, references: npt.ArrayLike, units: npt.ArrayLike) -> None:
        self._double = as_finite(references, "references", "(n, k)")
        if self._double.size == 0:
            raise ConformodalError(f"references must be finite, of shape (n, k), got shape {self._double.shape}")
        labels = as_labels(units, len(self._double), "units")
        codes = factorise(labels)[1]
        if not codes.any():
            raise ConformodalError("a novelty test needs two units of reference samples or more, got 1")
        given = np.asarray(references)  # float16 stays: it takes a quarter of the room
        self.references = given.astype(given.dtype.newbyteorder("=")) if given.dtype.char in "efd" else self._double
        self._square = (self._double**2).sum(axis=1)
        self._labels = labels
        self._rank(self._nearest(self._double, codes, codes), labels)

    def rescored(self, scores: npt.ArrayLike, units: npt.ArrayLike) -> Self:
        """The test with other scores (m,) of known samples, in units (m,), to rank new scores of their kind among.

        The samples need not be the references; exact where neither they nor the new one had a part in the score.
        """
        other, ranked = copy(self), as_scores(scores)
        other._rank(np.asarray(ranked, dtype=np.float64), as_labels(units, len(ranked), "units"))
        return other

    def _rank(self, scores: FloatArray, units: AnyArray) -> None:
        self.scores_, self.units_ = scores, units
        codes = factorise(units)[1]
        sizes = np.bincount(codes)
        self.n_units = len(sizes)
        self.weights_: FloatArray = 1 / sizes[codes]
        order = np.argsort(self.scores_, kind="stable")
        self._sorted = self.scores_[order]
        # weight of all reference samples from a rank on: what scores at least as much
        self._from = np.concatenate((np.cumsum(self.weights_[order][::-1])[::-1], [0.0]))

    def scores(self, samples: npt.ArrayLike, left_out: npt.ArrayLike | None = None) -> FloatArray:
        """Novelty scores (m,) of samples (m, k); references of a sample's unit in `left_out` (m,) do not count."""
        new = as_finite(samples, "samples", "(m, k)")
        if new.shape[1] != self.references.shape[1]:
            raise ConformodalError(f"samples must have shape (m, {self.references.shape[1]}), got {new.shape}")
        if left_out is None:
            return self._nearest(new)
        _, codes = factorise(np.concatenate((self._labels, as_labels(left_out, len(new), "left_out"))))
        return self._nearest(new, codes[len(self._labels) :], codes[: len(self._labels)])

    def p_values(self, scores: npt.ArrayLike) -> FloatArray:
        """``(1 + sum over units of the share of their scores that are at least as large) / (K + 1)``, (m,)."""
        at_least = self._from[np.searchsorted(self._sorted, as_scores(scores), side="left")]
        return np.asarray(np.minimum((1 + at_least) / (self.n_units + 1), 1.0))  # sums of weights are rounded

    def left_out_p_values(self) -> FloatArray:
        """P-values (n,) of the known samples among the other units, in the unit of :meth:`p_values`.

        Those of at most u are the same samples whichever new sample, with a larger p-value, joins them.
        """
        within = np.empty(len(self.scores_))  # share of the sample's unit that scores at least as much
        for members in rows_by_label(self.units_):
            ranked = np.sort(self.scores_[members])
            within[members] = 1 - np.searchsorted(ranked, self.scores_[members], side="left") / len(members)
        at_least = self._from[np.searchsorted(self._sorted, self.scores_, side="left")]
        return np.asarray((1 + at_least - within) / (self.n_units + 1))

    @property
    def least_p(self) -> float:
        """The smallest possible p-value."""
        return 1 / (self.n_units + 1)

    def _nearest(
        self, samples: FloatArray, codes: AnyArray | None = None, others: AnyArray | None = None
    ) -> FloatArray:
        distances = np.empty(len(samples))
        for start in range(0, len(samples), _ROWS):
            rows = slice(start, start + _ROWS)
            square = (samples[rows] ** 2).sum(axis=1)[:, None] + self._square - 2 * samples[rows] @ self._double.T
            if codes is not None:
                square[codes[rows, None] == others] = np.inf
            # from the difference itself: cancellation in the products would make equal samples differ
            apart = samples[rows] - self._double[square.argmin(axis=1)]
            distances[rows] = np.sqrt((apart**2).sum(axis=1))
        return distances
