"""Settings of the local regression, chosen by leaving groups of reference samples out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, IntArray, evenly_spread
from conformodal.features.projection import fit_projection
from conformodal.localizer.errors import LocalizationError
from conformodal.localizer.settings import NEIGHBOURS

from .regression import LocalAnswers, LocalRegression, LocalSettings

# Few components far from the references, many close to them.
LOCAL_CHOICES = tuple(
    LocalSettings(components, neighbours, ridge, radius)
    for components, neighbours, ridge, radius in product((16, 64, 256), (10, 20), (0.003, 0.03), (None, 0.5))
)


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Estimates of samples by a local regression that could not see their group."""

    rows: IntArray  # (m,) of the samples
    answers: LocalAnswers


def fit_local(
    features: Float32Array,
    targets: FloatArray,
    target_scale: FloatArray,
    groups: IntArray,
    *,
    choices: Sequence[LocalSettings] = LOCAL_CHOICES,
    views: Sequence[slice] = (slice(None),),
    progress: Callable[[int, int], None] | None = None,
) -> tuple[LocalRegression, LeftOut]:
    """The regression under which samples are most probable when their group (n,) is left out.

    The likelihood is that of a multivariate t distribution with one degree of freedom around each place, its scale
    fitted to the settings, so that outliers do not decide. Each choice is tried with each view of the features on some
    samples, and the best of them on more.
    """
    names, group = np.unique(groups, return_inverse=True)
    if len(names) < 2 or not choices:
        raise LocalizationError(f"needs two groups and one choice or more, got {len(names)} and {len(choices)}")
    rows = evenly_spread(len(features), NEIGHBOURS.left_out)
    regressions = []
    for view in views:
        projection = fit_projection(features, max(how.components for how in choices), view)
        if projection.components.ndim == 2:  # otherwise all the same in this view
            projected = np.asarray((features - projection.offset) @ projection.components, dtype=np.float32)
            regressions += [LocalRegression(projection, projected, targets, target_scale, how) for how in choices]
    if not regressions:
        raise LocalizationError("features are all the same")

    def tried(regression: LocalRegression, rows: IntArray) -> tuple[float, LeftOut]:
        answers = regression.predict_projected(regression.references[rows], (group[rows], group))
        return _log_likelihood(answers, targets[rows], target_scale), LeftOut(rows, answers)

    some, likelihoods = rows[:: -(-len(rows) // NEIGHBOURS.screened)], []
    for k, regression in enumerate(regressions):
        few = len(regressions) <= NEIGHBOURS.finalists
        likelihoods.append(0.0 if few else tried(regression, some)[0])
        if progress is not None:
            progress(k + 1, len(regressions))
    best = np.argsort(-np.array(likelihoods), kind="stable")[: NEIGHBOURS.finalists]
    found = [(*tried(regressions[k], rows), regressions[k]) for k in best.tolist()]
    _, left_out, regression = max(found, key=lambda each: each[0])
    return _slim(regression), left_out


def _slim(regression: LocalRegression) -> LocalRegression:
    """The same regression without the components that its settings do not use."""
    projection, projected = regression.projection, regression.references
    k = min(regression.settings.components, projected.shape[1])
    slim = replace(projection, components=np.ascontiguousarray(projection.components[:, :k]))
    return replace(regression, projection=slim, references=np.ascontiguousarray(projected[:, :k]))


def _log_likelihood(answers: LocalAnswers, targets: FloatArray, scale: FloatArray) -> float:
    d = targets.shape[1]
    miss = (((answers.values - targets[:, None]) / scale) ** 2).sum(axis=2)
    nearest = np.where(answers.weights > 0, miss, np.inf).min(axis=1)
    square = max(float(np.median(nearest)), 1e-12)
    for _ in range(20):  # the likeliest scale, by fixed point
        square = max((d + 1) / d * float(np.mean(nearest / (1 + nearest / square))), 1e-12)
    density = (answers.weights * (1 + miss / square) ** (-(d + 1) / 2)).sum(axis=1)
    return float(np.mean(np.log(density + 1e-300)) - d / 2 * np.log(square))
