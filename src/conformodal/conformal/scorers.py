"""Scorers of regions for scikit-learn's ``GridSearchCV``, ``cross_validate`` and others."""

from __future__ import annotations

from typing import Any, Literal, Self, get_args

import numpy as np
import numpy.typing as npt
from sklearn.utils.metadata_routing import MetadataRequest

from conformodal.core.arrays import FloatArray

from .checks import Alpha, as_alpha, as_choice, as_targets, brief, column_names, reason
from .density.mixture import as_sample_weight
from .errors import ConformodalTypeError
from .regions import Regions

ScorerName = Literal["coverage", "neg_length", "neg_interval_score"]
# of the density of a uniform distribution, which a logarithm is taken of at least
_LEAST_SHARE = 1e-6


class RegionScorer:
    """One scorer of :func:`region_scorers`, called by scikit-learn; a mean over samples and targets."""

    def __init__(self, name: ScorerName, alpha: Alpha = 0.1) -> None:
        as_choice(name, ScorerName, "name")
        as_alpha(alpha)
        self.name: ScorerName = name
        self.alpha = alpha
        self._request = MetadataRequest(owner=self)

    def __repr__(self) -> str:
        return f"RegionScorer({self.name!r}, alpha={self.alpha!r})"

    def __call__(
        self,
        estimator: Any,
        X: Any,
        y: npt.ArrayLike,
        sample_weight: npt.ArrayLike | None = None,
        groups: npt.ArrayLike | None = None,
    ) -> float:
        """Score a fitted regressor, or a pipeline that ends with one, on samples."""
        options = {} if groups is None else {"groups": groups}
        try:
            regions = estimator.predict(X, region=True, alpha=self.alpha, **options)
        except (TypeError, AttributeError) as exc:  # of a regressor without regions, or around one with them
            end = getattr(estimator, "steps", [("", estimator)])[-1][1]
            if hasattr(end, "predict_region") or isinstance(exc, ValueError):  # of a step before, or of one not fitted
                raise
            wanted = "a ConformalRegressor or a pipeline that ends with one"
            raise ConformodalTypeError(f"estimator must be {wanted}, got {brief(estimator)}: {reason(exc)}") from exc
        column_names(y, "y", regions.bins.names)
        values = as_targets(y)
        if self.name == "coverage":
            score = regions.contains(values).astype(np.float64)
        else:
            score = -regions.length if self.name == "neg_length" else -interval_score(regions, values, self.alpha)
        return _average(score.mean(axis=1), sample_weight)

    def set_score_request(self, **names: bool | str | None) -> Self:
        """Ask for ``sample_weight`` or ``groups`` if metadata routing is on, as in scikit-learn."""
        for name, alias in names.items():
            self._request.score.add_request(param=name, alias=alias)
        return self

    def get_metadata_routing(self) -> MetadataRequest:
        """What the scorer asks for."""
        return self._request


def log_density(estimator: Any, X: Any, y: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None) -> float:
    """Mean log density of true values, summed over targets: a scorer of scikit-learn; the larger, the better.

    A density below a millionth of that of a uniform distribution, as beyond all bins, counts as so much. `estimator` is
    a fitted regressor, or a pipeline that ends with one.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.model_selection import cross_val_score
    >>> from sklearn.tree import DecisionTreeClassifier
    >>> from conformodal.conformal import ConformalRegressor, log_density
    >>> X = np.random.default_rng(0).uniform(size=(400, 1))
    >>> reg = ConformalRegressor(DecisionTreeClassifier(max_depth=4), n_bins=10, random_state=0)
    >>> bool((cross_val_score(reg, X, X[:, 0], cv=2, scoring=log_density) > 0.5).all())
    True
    """
    regressor = estimator
    if hasattr(estimator, "steps"):
        X, regressor = estimator[:-1].transform(X), estimator[-1]
    density = regressor.predict_density(X)
    least = [_LEAST_SHARE / np.ptp(edges) for edges in density.bins.edges_]
    return _average(np.log(np.maximum(density.pdf(y), least)).sum(axis=1), sample_weight)


def _average(scores: FloatArray, sample_weight: npt.ArrayLike | None) -> float:
    """The weighted mean of the scores (n,) of samples."""
    return float(
        np.average(scores, weights=None if sample_weight is None else as_sample_weight(sample_weight, len(scores)))
    )


def region_scorers(alpha: Alpha = 0.1) -> dict[str, RegionScorer]:
    """Scorers of the regions at `alpha` by name, whatever the estimator's own rate; the larger, the better.

    - ``"coverage"``: share of values in their sets; not to be maximised.
    - ``"neg_length"``: minus the mean length.
    - ``"neg_interval_score"``: minus the length and, for a value outside its set, ``2 / alpha`` times its distance to
      the set (Gneiting and Raftery 2007, for one interval). From an empty set it is as far as the bins reach.

    ``GridSearchCV`` needs ``refit="neg_length"``, say; its ``best_estimator_.predict_region`` gives the regions. Groups
    given by ``params={"groups": g}`` reach a scorer with scikit-learn's ``enable_metadata_routing`` on, after
    ``set_score_request(groups=True)`` of each scorer and ``set_fit_request(groups=True)`` of the regressor.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.model_selection import cross_validate
    >>> from sklearn.tree import DecisionTreeClassifier
    >>> from conformodal.conformal import ConformalRegressor, region_scorers
    >>> X = np.random.default_rng(0).uniform(size=(400, 1))
    >>> reg = ConformalRegressor(DecisionTreeClassifier(max_depth=4), n_bins=10, random_state=0)
    >>> scores = cross_validate(reg, X, X[:, 0], cv=2, scoring=region_scorers(alpha=0.2))
    >>> bool(scores["test_coverage"].mean() > 0.7)
    True
    """
    return {name: RegionScorer(name, alpha) for name in get_args(ScorerName)}


def interval_score(regions: Regions, y: FloatArray, alpha: Alpha) -> FloatArray:
    """Lengths of sets, and ``2 / alpha`` times the distance of values (n, d) outside them, (n, d)."""
    parts = zip(regions.masks, regions.bins.edges_, y.T, strict=True)
    far = []
    for mask, e, values in parts:
        off = np.maximum(np.maximum(e[:-1] - values[:, None], values[:, None] - e[1:]), 0)
        nearest = np.where(mask, off, np.inf).min(axis=1)
        far.append(np.where(mask.any(axis=1), nearest, np.ptp(e)))  # an empty set is as far off as the range is wide
    distance = np.where(regions.contains(y), 0, np.stack(far, axis=1))
    return np.asarray(regions.length + 2 / float(as_alpha(alpha)) * distance)
