"""Split conformal calibration (the paper, section 2; Papadopoulos et al. 2002)."""

from __future__ import annotations

from copy import copy
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ..checks import Alpha, Probabilities, as_alpha
from ..errors import ConformalError, NotCalibratedError
from ..rank import conformal_quantile, conformal_rank
from ..regions import Regions
from .base import Calibrator, FloatArray


class SplitConformal(Calibrator):
    """Split conformal prediction sets over bins.

    If the calibration samples and a new sample are exchangeable (drawn together and split at random, say), and
    neither was used to fit the probabilities or the bins, then per target ``P(y in region) >= 1 - alpha``; with
    ``joint="bonferroni"`` or ``"max"`` all targets hold at once with that probability.

    Parameters
    ----------
    bins, alpha, score, joint, empty
        As in :class:`~conformodal.conformal.calibration.base.Calibrator`.

    Attributes
    ----------
    scores_ : (n, d) calibration scores of the true bins, ``+inf`` for values outside the edges
    thresholds_ : (d,) thresholds, ``+inf`` where n is too small for alpha

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

    scores_: npt.NDArray[np.floating[Any]]
    thresholds_: npt.NDArray[np.floating[Any]]

    @property
    def rank(self) -> int:
        """Rank k of the threshold among the calibration scores; n + 1 means the whole space."""
        return conformal_rank(self._calibrated().shape[0], self.alpha_per_target)

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike) -> Self:
        """Score the calibration samples and set the thresholds.

        Parameters
        ----------
        proba
            (n, d, K), or a list of d arrays (n, K_d).
        y
            (n, d) true values, or (n,) for one target. Values outside the edges score ``+inf``.

        Raises
        ------
        ConformalError
            On probabilities that are no probabilities, or shapes that do not fit each other or the bins.
        NotCalibratedError
            With ``joint="max"`` before :meth:`fit_scale`.
        """
        return self.calibrate_scores(self.score_samples(proba, y))

    def calibrate_scores(self, scores: FloatArray) -> Self:
        """Set the thresholds from calibration scores that are there already, (n, d)."""
        if scores.ndim != 2 or scores.shape[1] != self.bins.n_targets:
            raise ConformalError(f"scores must have shape (n, {self.bins.n_targets}), got {scores.shape}")
        column_thresholds = conformal_quantile(self.rule.columns(scores), self.alpha_per_target)
        self.scores_, self.thresholds_ = scores, self.rule.per_target(column_thresholds)
        return self

    def predict(self, proba: Probabilities) -> Regions:
        """Regions of new samples: every bin whose score is at most the threshold.

        Raises
        ------
        NotCalibratedError
            Before :meth:`calibrate`.
        ConformalError
            On probabilities that are no probabilities or do not fit the bins.
        """
        self._calibrated()
        return self.regions_at(proba, self.thresholds_)

    def at(self, alpha: Alpha) -> SplitConformal:
        """The same calibration at another miscoverage rate."""
        other = copy(self)
        as_alpha(alpha)
        other.alpha = alpha
        return other.calibrate_scores(self._calibrated())

    def p_values(self, proba: Probabilities, y: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Conformal p-values of values `y`, (n, d), or (n, 1) for ``joint="max"``.

        ``(1 + number of calibration scores at least as large) / (n + 1)``. With ``empty="allow"`` a value is in its
        region exactly if its p-value exceeds alpha.
        """
        calibration = np.sort(self.rule.columns(self._calibrated()), axis=0)
        new = self.rule.columns(self.score_samples(proba, y))
        n = calibration.shape[0]
        below = [np.searchsorted(c, s, side="left") for c, s in zip(calibration.T, new.T, strict=True)]
        return np.asarray((1 + n - np.stack(below, axis=1)) / (n + 1))

    def _calibrated(self) -> npt.NDArray[np.floating[Any]]:
        if not hasattr(self, "scores_"):
            raise NotCalibratedError("SplitConformal is not calibrated yet: call calibrate(proba, y) first")
        return self.scores_
