"""One threshold per group, so that coverage is guaranteed within each (Vovk et al. 2003)."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal.checks import Probabilities, as_known_labels, as_labels, as_probabilities, factorise
from conformodal.conformal.rank import conformal_quantile, conformal_rank
from conformodal.conformal.regions import Regions

from .base import Calibrator

_BY_GROUP = ("thresholds_", "sizes_")


class MondrianConformal(Calibrator):
    """Mondrian (group-conditional) conformal sets.

    If the calibration samples of a group and a new sample of that group are exchangeable, coverage is guaranteed within
    the group, not only on average over groups. Sets of a group that is new, or too small for a finite threshold, are
    unbounded.

    Parameters are those of :class:`~conformodal.conformal.calibrators.base.Calibrator`; for an example see
    ``docs/howto/groups-and-shift.md``.

    Attributes
    ----------
    groups_ : (n,) labels of the calibration samples
    thresholds_ : dict of group to (d,) thresholds
    sizes_ : dict of group to its number of calibration samples
    """

    def __getstate__(self) -> dict[str, Any]:
        # files of skops hold lists of any labels, but as keys of a dict only text and numbers
        return self.__dict__ | {name: list(vars(self)[name].items()) for name in _BY_GROUP if name in vars(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state | {name: dict(state[name]) for name in _BY_GROUP if name in state})

    def calibrate(self, proba: Probabilities, y: npt.ArrayLike, groups: npt.ArrayLike) -> Self:
        """Set one threshold per group; `groups` are (n,) labels: text, numbers or dates."""
        scores = self.score_samples(proba, y)
        self.warn_ties(scores)
        self.groups_ = as_labels(groups, scores.shape[0])
        self.scores_ = scores
        self._set_thresholds()
        return self

    def _set_thresholds(self) -> None:
        scores, alpha = self.calibration_columns(self.scores_), self.alpha_per_target
        self.thresholds_, self.sizes_ = {}, {}
        labels, codes = factorise(self.groups_)
        for code, label in enumerate(labels):
            members = scores[codes == code]
            self.sizes_[label] = members.shape[0]
            self.thresholds_[label] = self.per_target(conformal_quantile(members, alpha))

    @property
    def small_groups(self) -> list[Hashable]:
        """Groups with too few calibration samples for a finite threshold."""
        self._calibrated()
        alpha = self.alpha_per_target
        return [g for g, n in self.sizes_.items() if conformal_rank(n, alpha) > n]

    def predict(self, proba: Probabilities, groups: npt.ArrayLike) -> Regions:
        """Regions of new samples, each by its group's threshold; by the largest of all groups if it has no label.

        The largest guarantees coverage whichever of the groups such a sample is of.
        """
        self._calibrated()
        parts = as_probabilities(proba, self.bins.sizes)
        known, gaps = as_known_labels(groups, len(parts[0]))
        labels, codes = factorise(known)
        none = np.full(self.bins.n_targets, np.inf, dtype=self.scores_.dtype)
        by_label = np.array([self.thresholds_.get(label, none) for label in labels]).reshape(-1, none.size)
        limits = by_label[codes]
        limits[gaps] = np.max([*self.thresholds_.values()], axis=0)
        return self.regions_at(parts, limits)
