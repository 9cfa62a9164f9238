"""Estimators by name, fitted on one target; the expected time and the progress of a fit."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from sklearn.base import clone

from conformodal.conformal.checks import brief, reason
from conformodal.conformal.errors import ConformodalError, SlowFitWarning
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.words import counted

from .encoder import rows_of
from .quick import QuickDensity
from .smoothing import BinSmoothing, SmoothedClassifier, bin_codes, fit_classifier, proba_of_bins
from .stack import StackedDensity

LearnerName = Literal["quick", "stack"]

# fits of a classifier, each on all rows but every fifth; of fewer rows none is left out
_FOLDS = 5
_FEWEST_TO_LEAVE_OUT = 20
# a fit of more seconds is announced
_SLOW_S = 10.0


def as_learner(estimator: Any, random_state: int) -> tuple[Any, bool]:
    """The learner that `estimator` names or is, and whether it learns densities over bins."""
    if isinstance(estimator, str) and estimator not in get_args(LearnerName):
        raise ConformodalError(
            f"estimator must be one of {list(get_args(LearnerName))}, None or a classifier, got {brief(estimator)}"
        )
    if estimator is None or isinstance(estimator, str):
        return (StackedDensity if estimator == "stack" else QuickDensity)(random_state=random_state), True
    dense = hasattr(estimator, "fit_bins")
    for needed in ("fit_bins" if dense else "fit", "predict_proba", "get_params"):
        if isinstance(estimator, type) or not callable(getattr(estimator, needed, None)):
            raise ConformodalError(f"estimator must be None or a classifier with {needed}, got {brief(estimator)}")
    return estimator, dense


def split_off(
    n: int, share: float, random: np.random.RandomState, codes: IntArray | None = None
) -> tuple[IntArray, IntArray]:
    """Calibration samples, of each group with one of the `codes` (n,), and the others, of which 2 must be left."""
    order = random.permutation(n)
    n_held = int(np.ceil(share * n))
    if codes is not None:
        rank = np.empty(n, dtype=np.int64)
        for code in np.unique(codes):
            members = order[codes[order] == code]
            rank[members] = np.arange(members.size) >= np.ceil(share * members.size)
        order = order[np.argsort(rank[order], kind="stable")]
        n_held = n - int(rank.sum())
    if n - n_held < 2:
        each = "" if codes is None else f", 1 or more of each of {counted(np.unique(codes).size, 'group')}"
        raise ConformodalError(
            f"X has n_samples={n}, {n_held} of which are held out to calibrate{each}: at least 2 must be left"
        )
    return order[:n_held], order[n_held:]


def fit_target(
    base: Any,
    dense: bool,
    X: Any,
    y: FloatArray,
    edges: FloatArray,
    weight: FloatArray | None,
    out_of_fold: bool,
) -> tuple[Any, FloatArray | None]:
    """Clones of the learner, fitted on one target, and out-of-fold probabilities of the first rows, or None.

    A classifier is fitted five times without every fifth row, which tunes the smoothing; the five are averaged. A
    density is fitted on all rows, and for ``out_of_fold=True`` again without the first half. With fewer than 20 rows,
    none is left out. Rows must be in random order.
    """

    def fitted(rows: Any) -> Any:
        return _fitted(base, dense, rows_of(X, rows), y[rows], edges, None if weight is None else weight[rows])

    n, n_bins, fold = len(y), edges.size - 1, np.arange(len(y)) % _FOLDS
    enough = n >= _FEWEST_TO_LEAVE_OUT
    if dense:
        model, n_first = fitted(slice(None)), n // 2
        if not (enough and out_of_fold):
            return model, None
        return model, proba_of_bins(fitted(slice(n_first, None)), rows_of(X, slice(n_first)), n_bins)
    codes = bin_codes(y, edges)
    smoothing = BinSmoothing(codes, y, weight, n_bins)
    if not enough:
        return SmoothedClassifier([fitted(slice(None))], smoothing), None
    models, left_out = [], np.empty((n, n_bins))
    for k in range(_FOLDS):
        models.append(fitted(fold != k))
        left_out[fold == k] = proba_of_bins(models[-1], rows_of(X, fold == k), n_bins)
    smoothing.tune(left_out, codes, np.diff(edges), weight)
    return SmoothedClassifier(models, smoothing), smoothing(left_out)


def _fitted(base: Any, dense: bool, X: Any, y: FloatArray, edges: FloatArray, weight: FloatArray | None) -> Any:
    model = clone(base)
    try:
        accepted: Any = inspect.signature(model.fit_bins if dense else model.fit).parameters
    except (ValueError, TypeError):  # of a compiled method
        accepted = {}
    if weight is not None and "sample_weight" not in accepted:
        method = "fit_bins" if dense else "fit"
        raise ConformodalError(f"sample_weight needs an estimator whose {method} takes it, got {brief(base)}")
    try:
        if not dense:
            return fit_classifier(model, X, y, edges, weight)
        return model.fit_bins(X, y, edges, **({} if weight is None else {"sample_weight": weight}))
    except ConformodalError:
        raise
    except (ValueError, TypeError) as exc:
        raise ConformodalError(f"estimator cannot be fitted: {reason(exc)}") from exc


def warn_if_slow(base: Any, n_rows: int, n_features: int, fits: int) -> None:
    """Warn if `fits` fits will take more than ten seconds."""
    expected: Callable[[int, int], float] | None = getattr(base, "expected_seconds", None)
    seconds = 0.0 if expected is None else fits * expected(n_rows, n_features)
    if seconds > _SLOW_S:
        duration = f"{seconds:.0f} seconds" if seconds < 100 else f"{seconds / 60:.0f} minutes"
        hint = '; estimator="quick" takes seconds' if isinstance(base, StackedDensity) else ""
        rows = counted(n_rows, "row")
        warnings.warn(f"fitting {rows} will take about {duration}{hint}", SlowFitWarning, stacklevel=3)
