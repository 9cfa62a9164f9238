"""Split conformal calibration of binned probabilities (the paper, section 2)."""

from __future__ import annotations

from typing import Any, Literal, Self, cast, get_args

import numpy as np
import numpy.typing as npt

from .bins import QuantileBins
from .checks import Alpha, Probabilities, as_alpha, as_probabilities, as_targets
from .errors import ConformalError, NotCalibratedError
from .rank import conformal_quantile, conformal_rank
from .regions import Regions
from .scores import Score, resolve_score

Joint = Literal["none", "bonferroni"]


def as_joint(joint: str) -> Joint:
    """Check the name of a kind of joint coverage.

    Raises
    ------
    ConformalError
        If it is unknown.
    """
    if joint not in get_args(Joint):
        raise ConformalError(f"joint must be one of {list(get_args(Joint))}, got {joint!r}")
    return cast(Joint, joint)


class SplitConformal:
    """Split conformal prediction sets over bins.

    If the calibration samples and a new sample are exchangeable (drawn together and split at random, say), and
    neither was used to fit the probabilities or the bins, then per target ``P(y in region) >= 1 - alpha``; with
    ``joint="bonferroni"`` all targets hold at once with that probability.

    Parameters
    ----------
    bins
        Fitted bins.
    alpha
        Miscoverage rate in (0, 1).
    score
        ``"lac"`` (the paper's), ``"density"``, or a :class:`~conformodal.conformal.scores.Score`.
    joint
        ``"none"``: the promise holds for each target alone (the paper's). ``"bonferroni"``: every target is
        calibrated at alpha / d, so that the promise holds for all together.

    Attributes
    ----------
    scores_ : (n, d) calibration scores of the true bins, ``+inf`` for values outside the edges
    thresholds_ : (d,) thresholds, ``+inf`` where n is too small for alpha
    """

    scores_: npt.NDArray[np.floating[Any]]
    thresholds_: npt.NDArray[np.floating[Any]]

    def __init__(
        self, bins: QuantileBins, alpha: Alpha = 0.1, score: str | Score = "lac", joint: Joint = "none"
    ) -> None:
        self.bins = bins
        self.alpha = alpha
        self.score = resolve_score(score)
        self.joint = as_joint(joint)
        as_alpha(alpha)

    @property
    def alpha_per_target(self) -> Alpha:
        """The rate each target is calibrated at: an exact fraction."""
        alpha = as_alpha(self.alpha)
        return alpha / self.bins.n_targets if self.joint == "bonferroni" else alpha

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
        """
        return self.calibrate_scores(self.score_samples(proba, y))

    def calibrate_scores(self, scores: npt.NDArray[np.floating[Any]]) -> Self:
        """Set the thresholds from calibration scores that are there already, (n, d)."""
        if scores.ndim != 2 or scores.shape[1] != self.bins.n_targets:
            raise ConformalError(f"scores must have shape (n, {self.bins.n_targets}), got {scores.shape}")
        thresholds = conformal_quantile(scores, self.alpha_per_target)
        self.scores_, self.thresholds_ = scores, thresholds
        return self

    def score_samples(self, proba: Probabilities, y: npt.ArrayLike) -> npt.NDArray[np.floating[Any]]:
        """Scores of the true values, (n, d): what calibration ranks. A value is in its region exactly if its
        score is at most the threshold.
        """
        parts = as_probabilities(proba, self.bins.sizes)
        values = as_targets(y, n_targets=self.bins.n_targets)
        if values.shape[0] != parts[0].shape[0]:
            raise ConformalError(f"y has {values.shape[0]} rows, proba has {parts[0].shape[0]}")
        codes = self.bins.encode(values)
        scores = np.full(codes.shape, np.inf, dtype=np.result_type(*parts))
        rows = np.arange(codes.shape[0])
        for j, (part, widths) in enumerate(zip(parts, self.bins.widths, strict=True)):
            known = codes[:, j] >= 0
            scores[known, j] = self.score.of_bins(part, widths)[rows[known], codes[known, j]]
        return scores

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
        parts = as_probabilities(proba, self.bins.sizes)
        masks = [
            self.score.of_bins(part, widths) <= threshold
            for part, widths, threshold in zip(parts, self.bins.widths, self.thresholds_, strict=True)
        ]
        unbounded = np.broadcast_to(np.isposinf(self.thresholds_), (parts[0].shape[0], self.bins.n_targets))
        return Regions(self.bins, masks, unbounded.copy())

    def _calibrated(self) -> npt.NDArray[np.floating[Any]]:
        if not hasattr(self, "scores_"):
            raise NotCalibratedError("SplitConformal is not calibrated yet: call calibrate(proba, y) first")
        return self.scores_
