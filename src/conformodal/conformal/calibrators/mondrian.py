"""One threshold per group, so that coverage is guaranteed within each (Vovk et al. 2003)."""

from __future__ import annotations

from collections.abc import Hashable
from copy import copy
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.bins import QuantileBins
from conformodal.conformal.checks import (
    Alpha,
    Probabilities,
    as_alpha,
    as_choice,
    as_labels,
    as_probabilities,
    factorise,
)
from conformodal.conformal.rank import conformal_quantile, conformal_rank
from conformodal.conformal.regions import Regions
from conformodal.conformal.scores import Score
from conformodal.core.arrays import AnyArray, RealArray

from .base import Calibrator, Empty, Joint

Fallback = Literal["whole", "pooled"]
_BY_GROUP = ("thresholds_", "sizes_")


class MondrianConformal(Calibrator):
    """Mondrian (group-conditional) conformal sets.

    If the calibration samples of a group and a new sample of that group are exchangeable, coverage is guaranteed within
    the group, not only on average over groups.

    Parameters
    ----------
    bins, alpha, score, joint, empty
        As in :class:`~conformodal.conformal.calibrators.base.Calibrator`.
    fallback
        For groups that are new, or too small for a finite threshold. ``"whole"``: an unbounded set, which keeps the
        guarantee. ``"pooled"``: the threshold of all calibration samples, with a guarantee on average over all groups
        only.

    Attributes
    ----------
    scores_, groups_ : (n, d) calibration scores and (n,) labels
    thresholds_ : dict of group to (d,) thresholds
    sizes_ : dict of group to its number of calibration samples
    pooled_ : (d,) thresholds of all samples together

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import MondrianConformal, QuantileBins
    >>> bins = QuantileBins.from_edges([[0, 1, 2, 3]])
    >>> y, groups = np.tile([0.5, 2.5], 22), np.array(["many"] * 40 + ["few"] * 4)
    >>> proba = np.tile([0.45, 0.1, 0.45], (44, 1))
    >>> by_group = MondrianConformal(bins, alpha=0.1).calibrate(proba, y, groups)
    >>> regions = by_group.predict(proba[:2], ["many", "few"])
    >>> regions.length[:, 0], by_group.fallback_groups  # four samples are too few for alpha = 0.1
    (array([ 2., inf]), ['few'])
    """

    scores_: RealArray
    groups_: AnyArray
    thresholds_: dict[Hashable, RealArray]
    sizes_: dict[Hashable, int]
    pooled_: RealArray

    def __init__(
        self,
        bins: QuantileBins,
        alpha: Alpha = 0.1,
        score: str | Score = "lac",
        joint: Joint = "none",
        empty: Empty = "allow",
        fallback: Fallback = "whole",
    ) -> None:
        super().__init__(bins, alpha, score, joint, empty)
        self.fallback = fallback

    def check_parameters(self) -> None:
        """Refuse parameters that are not valid; called before scores are taken."""
        super().check_parameters()
        as_choice(self.fallback, Fallback, "fallback")

    def __getstate__(self) -> dict[str, Any]:
        # files of skops hold lists of any labels, but as keys of a dict only text and numbers
        return self.__dict__ | {name: list(vars(self)[name].items()) for name in _BY_GROUP if name in vars(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {name: dict(state[name]) for name in _BY_GROUP if name in state})

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, groups: npt.ArrayLike) -> Self:
        """Set one threshold per group; `groups` are (n,) labels: text, numbers or dates."""
        scores = self.score_samples(proba, y)
        self.groups_ = as_labels(groups, scores.shape[0])
        self.scores_ = scores
        return self._set_thresholds()

    def at(self, alpha: Alpha) -> Self:
        """The same calibration at another miscoverage rate."""
        self._calibrated()
        as_alpha(alpha)
        other = copy(self)
        other.alpha = alpha
        return other._set_thresholds()

    def _set_thresholds(self) -> Self:
        scores, alpha = self._calibration_columns(self.scores_), self.alpha_per_target
        self.pooled_ = self.per_target(conformal_quantile(scores, alpha))
        self.thresholds_, self.sizes_ = {}, {}
        labels, codes = factorise(self.groups_)
        for code, label in enumerate(labels):
            members = scores[codes == code]
            self.sizes_[label] = members.shape[0]
            self.thresholds_[label] = self.per_target(conformal_quantile(members, alpha))
            self.warn_of_whole_range(self.thresholds_[label], f" in group {label}")
        return self

    @property
    def fallback_groups(self) -> list[Hashable]:
        """Groups of the calibration samples that fall back."""
        self._calibrated()
        # only the number counts: a group with many values outside the edges may have an infinite threshold itself
        alpha = self.alpha_per_target
        return [g for g, n in self.sizes_.items() if conformal_rank(n, alpha) > n]

    def predict(self, proba: Probabilities, groups: npt.ArrayLike) -> Regions:
        """Regions of new samples, each by its group's threshold."""
        self._calibrated()
        parts = as_probabilities(proba, self.bins.sizes)
        labels, codes = factorise(as_labels(groups, len(parts[0])))
        fallback = self.pooled_ if self.fallback == "pooled" else np.full_like(self.pooled_, np.inf)
        fallback_groups = set(self.fallback_groups)
        limits = np.empty((len(codes), self.bins.n_targets), dtype=self.pooled_.dtype)
        for code, label in enumerate(labels):
            limits[codes == code] = fallback if label in fallback_groups else self.thresholds_.get(label, fallback)
        return self.regions_at(parts, limits)
