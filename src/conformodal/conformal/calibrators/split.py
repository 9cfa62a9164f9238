"""Split conformal calibration (the paper, section 2; Papadopoulos et al. 2002)."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Probabilities, as_labels, as_scores, factorise
from conformodal.conformal.rank import conformal_quantile, conformal_rank, hierarchical_quantile
from conformodal.conformal.regions import Regions
from conformodal.conformal.streams import ScoreSource, ScoreStream, is_source, stream_quantiles
from conformodal.core.arrays import IntArray, RealArray, rows_by_label
from conformodal.core.errors import ConformodalError

from .base import Calibrator


class SplitConformal(Calibrator):
    """Split conformal prediction sets over bins.

    If the calibration samples and a new sample are exchangeable (drawn together and split at random, say), and neither
    was used to fit the probabilities or the bins, then ``P(y in region) >= 1 - alpha`` per target, or with
    ``joint="bonferroni"`` or ``"max"`` for all targets together.

    With ``units``, such as parts of a video or whole recordings, only the units need to be exchangeable, and coverage
    is guaranteed for a random sample of a new unit (Dunn, Wasserman and Ramdas 2023; Lee, Barber and Willett 2023).

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`.

    Attributes
    ----------
    units_ : (n,) unit of each calibration sample, or None if samples are exchangeable
    unit_sizes_ : (n,) size of each sample's whole unit, if only one category of its members is here, or None
    thresholds_ : (d,) thresholds, above a score by what it may be rounded, ``+inf`` where n is too small for alpha

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuantileBins, SplitConformal
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 3]])
    >>> proba = np.tile([0.45, 0.1, 0.45], (40, 1))
    >>> y = np.tile([0.5, 2.5], 20)
    >>> SplitConformal(bins, alpha=0.1).calibrate(proba, y).predict(proba[:1]).intervals(0)
    [array([[0., 1.],
           [2., 3.]])]
    """

    @property
    def rank(self) -> int:
        """Rank k of the threshold among the exchangeable units; n_units + 1 means an unbounded set."""
        return conformal_rank(self.n_units, self.alpha_per_target)

    @property
    def n_units(self) -> int:
        """Exchangeable units behind the thresholds: calibration samples, or what they were drawn together in."""
        scores = self._calibrated()
        return len(scores if self.units_ is None else np.unique(self.units_))

    @property
    def weight(self) -> Fraction:
        """Calibration samples in exchangeable units, each one over the size of its unit.

        Thresholds are finite only from ``1 / alpha_per_target - 1`` on.
        """
        n = len(self._calibrated())
        if self.units_ is None:
            return Fraction(n)
        codes = factorise(self.units_)[1]
        sizes = np.bincount(codes)[codes] if self.unit_sizes_ is None else self.unit_sizes_
        return sum((Fraction(1, size) for size in sizes.tolist()), Fraction(0))

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, units: npt.ArrayLike | None = None) -> Self:
        """Score the calibration samples and set the thresholds.

        `proba` is (n, d, K) or a list of d arrays (n, K_d); `y` are (n, d) true values, or (n,) for one target; `units`
        are (n,) labels of what samples were drawn together in: text, numbers or dates.
        """
        scores = self.score_samples(proba, y)
        self.warn_ties(scores)
        return self.calibrate_scores(scores, units)

    def calibrate_scores(
        self, scores: RealArray | ScoreSource, units: npt.ArrayLike | None = None, unit_sizes: IntArray | None = None
    ) -> Self:
        """Set the thresholds from calibration scores (n, d) of :meth:`score_samples`.

        More scores than memory holds come from a source: a :class:`numpy.memmap`, or a function that returns their
        chunks, from the first on, each time it is called (without `units`). Thresholds are exactly those of the array;
        see :class:`~conformodal.conformal.streams.ScoreStream`.

        `unit_sizes` (n,) are the sizes of the whole units if only members of one category are given, see
        :func:`~conformodal.conformal.hierarchical_quantile`.
        """
        self.check_parameters()
        if is_source(scores):
            if units is not None:
                raise ConformodalError("units must be None for scores of a source")
            self.scores_: Any = ScoreStream(scores, self._columns_of_chunk)
            self.units_, self.unit_sizes_ = None, None
            self._set_thresholds()
            return self
        scores = as_scores(scores)
        self._check_shape(scores)
        if units is not None:
            units = as_labels(units, len(scores), "units")
        self.scores_, self.units_, self.unit_sizes_ = scores, units, unit_sizes
        self._set_thresholds()
        return self

    def _check_shape(self, scores: RealArray) -> None:
        if scores.ndim != 2 or scores.shape[1] != self.bins.n_targets:
            raise ConformodalError(f"scores must have shape (n, {self.bins.n_targets}), got {scores.shape}")

    def _columns_of_chunk(self, scores: RealArray) -> RealArray:
        self._check_shape(scores)
        return self.calibration_columns(scores)

    def _set_thresholds(self) -> None:
        rate = self.alpha_per_target
        if isinstance(self.scores_, ScoreStream):
            self.thresholds_ = self.per_target(stream_quantiles(self.scores_, self.rank))
            return
        columns = self.calibration_columns(self.scores_)
        if self.units_ is None:
            self.thresholds_ = self.per_target(conformal_quantile(columns, rate))
            return
        rows, sizes = rows_by_label(self.units_), self.unit_sizes_
        whole = None if sizes is None else [int(sizes[members[0]]) for members in rows]
        limits = [hierarchical_quantile([column[m] for m in rows], rate, whole) for column in columns.T]
        self.thresholds_ = self.per_target(np.array(limits))

    def predict(self, proba: Probabilities) -> Regions:
        """Regions of new samples: every bin whose score is at most the threshold."""
        self._calibrated()
        return self.regions_at(proba, self.thresholds_)
