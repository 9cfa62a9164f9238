"""Scorers of regions for scikit-learn's ``GridSearchCV``, ``cross_validate`` and others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from .checks import Alpha, as_alpha
from .density.mixture import as_sample_weight

ScorerName = Literal["coverage", "neg_length"]
Scorer: TypeAlias = Callable[[Any, Any, Any], float]
# of the density of a uniform distribution, which a logarithm is taken of at least
_LEAST_SHARE = 1e-6


def log_density(estimator: Any, X: Any, y: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None) -> float:
    """Mean log density of true values, summed over targets: a scorer of scikit-learn; the larger, the better.

    A density below a millionth of that of a uniform distribution, as beyond all bins, counts as so much. `estimator` is
    a fitted regressor, or a pipeline that ends with one: ``cross_val_score(reg, X, y, scoring=log_density)``.
    """
    regressor = estimator
    if hasattr(estimator, "steps"):
        X, regressor = estimator[:-1].transform(X), estimator[-1]
    density = regressor.predict_density(X)
    least = [_LEAST_SHARE / np.ptp(edges) for edges in density.bins.edges_]
    scores = np.log(np.maximum(density.pdf(y), least)).sum(axis=1)
    weights = None if sample_weight is None else as_sample_weight(sample_weight, len(scores))
    return float(np.average(scores, weights=weights))


def region_scorers(alpha: Alpha = 0.1) -> dict[str, Scorer]:
    """Scorers of the regions at `alpha` by name, whatever the estimator's own rate; the larger, the better.

    Each is a mean over samples and targets. ``GridSearchCV`` needs ``refit="neg_length"``, say; its
    ``best_estimator_.predict_region`` gives the regions.

    - ``"coverage"``: share of values in their sets; not to be maximised.
    - ``"neg_length"``: minus the mean length.

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
    as_alpha(alpha)
    return {name: partial(_score_regions, name=name, alpha=alpha) for name in get_args(ScorerName)}


def _score_regions(estimator: Any, X: Any, y: npt.ArrayLike, name: ScorerName, alpha: Alpha) -> float:
    """Score a fitted regressor, or a pipeline that ends with one, on samples."""
    regions = estimator.predict(X, region=True, alpha=alpha)
    return float(regions.contains(y).mean() if name == "coverage" else -regions.length.mean())
