"""Cross-conformal sets over given folds (Vovk 2015; Barber, Candes, Ramdas and Tibshirani 2021)."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Probabilities, as_labels, as_probabilities, factorise
from conformodal.conformal.rank import conformal_rank
from conformodal.conformal.regions import Regions
from conformodal.core.arrays import RealArray
from conformodal.core.errors import ConformodalError

from .base import Calibrator


class CrossConformal(Calibrator):
    """Every sample is scored by a model that did not see its fold; all models score new samples.

    A value belongs to the set if fewer than k of the n calibration scores are smaller than its own score by the model
    of the same fold; k is :func:`~conformodal.conformal_rank`. With one fold this is split conformal prediction.

    With exchangeable samples and random folds of equal size, coverage is at least ``1 - 2 alpha`` less a term that
    falls with n (Barber et al., theorem 4), and about ``1 - alpha`` in practice. For folds that are contiguous blocks
    of a recording nothing is proven, as blocks are not exchangeable. Fit the bins once, on all samples.

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`; `joint` is ``"none"`` or
    ``"bonferroni"``.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import CrossConformal, QuantileBins
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 3]])
    >>> y, folds = np.tile([0.5, 2.5], 20), np.repeat([0, 1], 20)
    >>> proba = np.tile([0.45, 0.1, 0.45], (40, 1))  # of each row by the model that has not seen its fold
    >>> cross = CrossConformal(bins, alpha=0.1).calibrate(proba, y, folds)
    >>> cross.predict({0: proba[:1], 1: proba[:1]}).intervals(0)  # a new sample, by both models
    [array([[0., 1.],
           [2., 3.]])]
    """

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, folds: npt.ArrayLike) -> Self:
        """Score all samples out of fold.

        Row i of `proba`, (n, d, K) or a list of d arrays, is by the model that was fitted without the samples of fold
        ``folds[i]``; `y` are (n, d) true values, or (n,) for one target; `folds` are (n,) labels.
        """
        if self.joint == "max":
            raise ConformodalError('joint="max" has no cross-conformal form here; use "none" or "bonferroni"')
        scores = self.score_samples(proba, y)
        names, codes = factorise(as_labels(folds, scores.shape[0], "folds"))
        if not names:
            raise ConformodalError("folds must hold at least one sample")
        self.scores_ = {fold: np.sort(scores[codes == k], axis=0) for k, fold in enumerate(names)}
        return self

    @property
    def rank(self) -> int:
        """Rank k: a value with k or more smaller scores is left out; n + 1 means an unbounded set."""
        return conformal_rank(sum(s.shape[0] for s in self._calibrated().values()), self.alpha_per_target)

    def predict(self, proba: Mapping[Hashable, Probabilities]) -> Regions:
        """Regions of new samples; `proba` maps every fold to the probabilities by its model, fitted without it."""
        calibrated: dict[Hashable, RealArray] = self._calibrated()
        if not isinstance(proba, Mapping) or set(proba) != set(calibrated):
            raise ConformodalError(f"proba must map each of the folds {list(calibrated)} to probabilities")
        parts = {fold: as_probabilities(p, self.bins.sizes, f"proba[{fold!r}]") for fold, p in proba.items()}
        n = len(next(iter(parts.values()))[0])
        if any(len(part[0]) != n for part in parts.values()):
            raise ConformodalError("proba must have as many rows in each fold")
        masks = []
        for j, (widths, size) in enumerate(zip(self.bins.widths, self.bins.sizes, strict=True)):
            smaller = np.zeros((n, size), dtype=np.int64)
            for fold, scores in calibrated.items():
                each = self.scores_of(parts[fold][j], widths).astype(np.float64)
                rounding = self.rounding(np.where(np.isfinite(each), np.abs(each), 0), scores.dtype)
                smaller += np.searchsorted(scores[:, j], each - rounding, side="left")
            mask = smaller < self.rank
            if self.empty == "mode":
                rows = np.flatnonzero(~mask.any(axis=1))
                mask[rows, smaller[rows].argmin(axis=1)] = True
            masks.append(mask)
        # a value outside the edges scores +inf by every model: all finite scores are smaller
        finite = sum(np.isfinite(s).sum(axis=0) for s in calibrated.values())
        unbounded = np.broadcast_to(finite < self.rank, (n, self.bins.n_targets)).copy()
        return Regions(self.bins, masks, unbounded)
