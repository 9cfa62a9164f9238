"""The pose source by locally linear regression (Cleveland 1979) among similar training frames, one answer per place.

Among a few frames that look alike, targets are nearly linear in features. Frames that look alike may come from several
places: neighbours are clustered by their targets first, and each cluster gets a regression, so that no answer is the
mean of two places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from conformodal.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray, evenly_spread
from conformodal.core.ranges import Range
from conformodal.core.schema import ArraySpec
from conformodal.features.backbone import feature_views
from conformodal.features.head import Projection, fit_projection
from conformodal.geometry import angle_between_quats, normalise_quat
from conformodal.localizer.evidence import ErrorModel, FrameEvidence, HeldOutErrors, PoseMeasurement, fit_error_model
from conformodal.localizer.training_data import TrainingData

from .registry import SourceAnswer, SourceState, register_source

_CHUNK = 256  # queries at once: their neighbours' features are copied
_PLACES = 4  # answers at most, one per place
_CROWD = 4  # frames that are clustered by place, in units of the frames of one regression
_DECAY = 2.0  # the weight of the farthest frame is exp(-decay) (Cleveland 1979)
_MIN_WEIGHT = 0.02  # of an answer
_SAME_PLACE = 0.5  # standard deviations of the targets within which answers are of the same place
_USUAL = 0.9  # quantile of the novelty of left-out frames above which standard deviations grow with novelty
_DISTRUST = 4.0  # exponent with which the odds of an inlier fall above that
_LEFT_OUT = 800  # frames that settings are chosen on, at most
_SCREENED, _FINALISTS = 200, 8  # of these, that all settings are tried on; settings that are tried on all of them

_ARRAYS = {
    "references": ArraySpec("f", ("m", "k")),
    "targets": ArraySpec("d", ("m", 7)),
    "target_scale": ArraySpec("d", (7,), "positive"),
    "offset": ArraySpec("f", ("n_features",)),
    "components": ArraySpec("ef", ("n_features", "k")),
}
_COUNT, _POSITIVE = Range(1, 1_000_000, whole=True), Range(0, 1e9, "(]")
_SETTINGS: dict[str, Any] = {
    "regression": {"components": _COUNT, "neighbours": _COUNT, "ridge": Range(0, 1e9), "radius": (None, _POSITIVE)},
    "errors": ErrorModel.json_schema(n_support=1),
    "typical": _POSITIVE,
    "limit": _POSITIVE,
    "least_sigma_m": _POSITIVE,
}


class LocalSettings(NamedTuple):
    """Settings of the regression."""

    components: int  # leading principal components of the features
    neighbours: int  # samples of one regression
    ridge: float  # penalty on the slope, in units of the neighbours' spread
    radius: float | None  # of a place, in units of the targets' spread; None takes all neighbours for one place


# Few components far from the references, many close to them.
_CHOICES = tuple(LocalSettings(*c) for c in product((16, 64, 256), (10, 20), (0.003, 0.03), (None, 0.5)))


class LocalAnswers(NamedTuple):
    """Estimates for m queries, one for each of up to P places."""

    values: FloatArray  # (m, P, d) targets
    weights: FloatArray  # (m, P) that sum to one; 0 for places that a query does not have
    novelty: FloatArray  # (m,) distance in features from a query to the span of its neighbours at the nearest place


@dataclass(frozen=True, eq=False)
class LocalRegression:
    """Local regression among n reference samples."""

    projection: Projection
    references: Float32Array  # (n, k) projected features
    targets: FloatArray  # (n, d)
    target_scale: FloatArray  # (d,) units of distances between targets
    settings: LocalSettings

    def predict(self, queries: Float32Array, hidden: BoolArray | None = None) -> LocalAnswers:
        """Estimates for projected features (m, k), m > 0; `hidden` (m, n) are references that a query must not see."""
        chunks = [slice(start, start + _CHUNK) for start in range(0, len(queries), _CHUNK)]
        answers = [self._answer(queries[rows], None if hidden is None else hidden[rows]) for rows in chunks]
        return LocalAnswers(*map(np.concatenate, zip(*answers, strict=True)))

    def slim(self) -> LocalRegression:
        """The same regression without the components that its settings do not use."""
        k = min(self.settings.components, self.references.shape[1])
        projection = replace(self.projection, components=np.ascontiguousarray(self.projection.components[:, :k]))
        return replace(self, projection=projection, references=np.ascontiguousarray(self.references[:, :k]))

    def _answer(self, queries: Float32Array, hidden: BoolArray | None) -> LocalAnswers:
        how = self.settings
        x, references = (part[:, : how.components].astype(np.float64) for part in (queries, self.references))
        square = (references**2).sum(axis=1) - 2 * x @ references.T + (x**2).sum(axis=1)[:, None]
        square = np.maximum(square, 0)
        if hidden is not None:
            square[hidden] = np.inf
        n_places = 1 if how.radius is None else _PLACES
        crowd = min(how.neighbours * (1 if how.radius is None else _CROWD), len(references))
        near = np.argpartition(square, crowd - 1, axis=1)[:, :crowd]
        near = np.take_along_axis(near, np.argsort(np.take_along_axis(square, near, axis=1), axis=1), axis=1)
        square = np.take_along_axis(square, near, axis=1)
        visible = np.isfinite(square)
        square = np.where(visible, square, 0)
        reach = square[:, : how.neighbours].max(axis=1, keepdims=True)
        kernel = np.where(visible, np.exp(-_DECAY * square / np.maximum(reach, 1e-12)), 0)
        place = np.zeros_like(near) if how.radius is None else self._places(near, visible, how.radius)
        values = np.zeros((len(x), n_places, self.targets.shape[1]))
        weights, novelty = np.zeros((len(x), n_places)), np.zeros(len(x))
        for p in range(n_places):
            share = np.where(place == p, kernel, 0)
            share[np.cumsum(share > 0, axis=1) > how.neighbours] = 0
            weights[:, p] = share.sum(axis=1)
            rows = np.flatnonzero(weights[:, p] > 0) if p else np.arange(len(x))  # most have one place or two
            first = np.argsort(share[rows] == 0, axis=1, kind="stable")[:, : how.neighbours]
            chosen = np.take_along_axis(near[rows], first, axis=1)
            share = np.take_along_axis(share[rows], first, axis=1)
            values[rows, p], distance = _ridge(references[chosen], self.targets[chosen], share, x[rows], how.ridge)
            novelty = novelty if p else distance  # the place of the nearest neighbour
        total = weights.sum(axis=1, keepdims=True)
        return LocalAnswers(values, weights / np.where(total > 0, total, 1), novelty)

    def _places(self, near: IntArray, visible: BoolArray, radius: float) -> IntArray:
        """(m, crowd) place of each neighbour, below 0 for none: the nearest one without a place starts the next."""
        where = self.targets[near] / self.target_scale
        place = np.where(visible, -1, -2)
        for p in range(_PLACES):
            leader = np.argmax(place == -1, axis=1)
            far = np.linalg.norm(where - np.take_along_axis(where, leader[:, None, None], axis=1), axis=2)
            place[(far < radius) & (place == -1)] = p
        return place


def _ridge(
    x: FloatArray, y: FloatArray, weights: FloatArray, queries: FloatArray, ridge: float
) -> tuple[FloatArray, FloatArray]:
    """Weighted ridge regressions of y (m, N, d) on x (m, N, k) at queries (m, k), and the queries' distances (m,)."""
    total = weights.sum(axis=1, keepdims=True)
    share = (weights / np.where(total > 0, total, 1))[:, :, None]
    centre, middle = (share * x).sum(axis=1), (share * y).sum(axis=1)
    root = np.sqrt(share)
    a, b = (x - centre[:, None]) * root, (y - middle[:, None]) * root
    offset = queries - centre
    gram = a @ a.transpose(0, 2, 1)
    n = gram.shape[1]
    spread = np.trace(gram, axis1=1, axis2=2) / n
    gram[:, np.arange(n), np.arange(n)] += (ridge * spread + 1e-12)[:, None]
    cross = (a @ offset[:, :, None])[:, :, 0]
    solved = np.linalg.solve(gram, np.concatenate((b, cross[:, :, None]), axis=2))
    values = middle + np.einsum("mn,mnd->md", cross, solved[:, :, :-1])
    square = (offset**2).sum(axis=1) - (cross * solved[:, :, -1]).sum(axis=1)
    return values, np.sqrt(np.maximum(square, 0))


class LeftOut(NamedTuple):
    """Estimates of samples by a local regression that could not see their group."""

    regression: LocalRegression
    rows: IntArray  # (m,) of the samples
    answers: LocalAnswers


def fit_local(
    features: Float32Array,
    targets: FloatArray,
    groups: IntArray,
    *,
    choices: Sequence[LocalSettings] = _CHOICES,
    views: Sequence[slice] = (slice(None),),
) -> LeftOut:
    """The regression under which samples are most probable when their group (n,) is left out, with these estimates.

    The likelihood is that of a multivariate t distribution with one degree of freedom around each place, its scale
    fitted to the settings, so that outliers do not decide. Each choice is tried with each view of the features on some
    samples, and the best of them on more.
    """
    rows, variance = evenly_spread(len(features), _LEFT_OUT), targets.var(axis=0)
    # targets are compared in units of the spread of all positions, and of that of all orientations
    scale = np.maximum(np.sqrt([variance[:3].sum()] * 3 + [variance[3:].sum()] * 4), 1e-6)
    regressions = []
    for view in views:
        projection = fit_projection(features, max(how.components for how in choices), view)
        if projection.components.ndim == 2:  # otherwise all the same in this view
            references = projection.apply(features)
            regressions += [LocalRegression(projection, references, targets, scale, how) for how in choices]

    def left_out(regression: LocalRegression, rows: IntArray) -> LeftOut:
        hidden = groups[rows][:, None] == groups
        return LeftOut(regression, rows, regression.predict(regression.references[rows], hidden))

    some = rows[:: -(-len(rows) // _SCREENED)]
    likelihoods = [_log_likelihood(left_out(regression, some)) for regression in regressions]
    best = np.argsort(-np.array(likelihoods), kind="stable")[:_FINALISTS]
    return max((left_out(regressions[k], rows) for k in best.tolist()), key=_log_likelihood)


def _log_likelihood(left_out: LeftOut) -> float:
    (values, weights, _), targets = left_out.answers, left_out.regression.targets[left_out.rows]
    d = targets.shape[1]
    miss = (((values - targets[:, None]) / left_out.regression.target_scale) ** 2).sum(axis=2)
    nearest = np.where(weights > 0, miss, np.inf).min(axis=1)
    square = max(float(np.median(nearest)), 1e-12)
    for _ in range(20):  # the likeliest scale, by fixed point
        square = max((d + 1) / d * float(np.mean(nearest / (1 + nearest / square))), 1e-12)
    density = (weights * (1 + miss / square) ** (-(d + 1) / 2)).sum(axis=1)
    return float(np.mean(np.log(density + 1e-300)) - d / 2 * np.log(square))


@register_source
@dataclass(frozen=True, eq=False)
class NeighbourSource:
    """A local regression among `frames` (m,), and its errors on frames that were left out."""

    name: ClassVar[str] = "neighbours"
    local: ClassVar[bool] = False

    regression: LocalRegression
    frames: IntArray
    typical: float  # median novelty of left-out frames
    limit: float  # its upper end
    errors: ErrorModel  # as a function of novelty
    least_sigma_m: float  # that it states of images: of left-out frames, nine in ten have a larger one

    @classmethod
    def fit(cls, data: TrainingData, frames: IntArray) -> Self | None:
        """Choose the settings of the regression by leaving pieces out; None where there is only one piece."""
        features, targets, pieces = data.features[frames], data.targets[frames], data.pieces[frames]
        if len(np.unique(pieces)) < 2 or not np.ptp(features, axis=0).any():
            return None
        views = feature_views(features.shape[1])
        regression, rows, answers = fit_local(features, targets, pieces, views=views)
        truth, typical = targets[rows, None], max(float(np.median(answers.novelty)), 1e-9)
        same_place, offered = _SAME_PLACE * float(regression.target_scale[0]), answers.weights >= _MIN_WEIGHT
        values = np.where(offered[:, :, None], answers.values, truth)
        off = np.linalg.norm(values[:, :, :3] - truth[:, :, :3], axis=2)
        angle = angle_between_quats(values[:, :, 3:], truth[:, :, 3:])
        nearest = np.arange(len(off)), np.where(offered, off / same_place + angle, np.inf).argmin(axis=1)
        novelty, distance, weights = np.maximum(answers.novelty / typical, 1e-3), np.zeros(len(off)), np.ones(len(off))
        held_out = HeldOutErrors(
            off[nearest], novelty, angle[nearest], novelty, distance, 1 / novelty[:, None], weights
        )
        errors = fit_error_model(held_out, same_place)
        limit = max(float(np.quantile(answers.novelty, _USUAL)), typical)
        if errors is None:
            return None
        least = float(np.quantile(errors.position * novelty**errors.position_growth, 1 - _USUAL))
        return cls(regression.slim(), frames, typical, limit, errors, least)

    def extended(self, data: TrainingData, numbers: IntArray, *, learn_errors: bool = True) -> Self:
        """With all frames of other data, whose `numbers` (n,) among the known frames are larger than the known ones.

        Projection, settings and errors stay as they were learnt, whatever `learn_errors` is.
        """
        one = self.regression
        references = np.concatenate((one.references, one.projection.apply(data.features)))
        grown = replace(one, references=references, targets=np.concatenate((one.targets, data.targets)))
        return replace(self, regression=grown, frames=np.concatenate((self.frames, numbers)))

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """One estimate per place that the nearest frames come from."""
        if not len(evidence.features):
            return SourceAnswer()
        answers = self.regression.predict(self.regression.projection.apply(evidence.features))
        novelty = np.maximum(answers.novelty / self.typical, 1e-3)
        rows = zip(answers.values, answers.weights, novelty.tolist(), strict=True)
        return SourceAnswer(measurements=[self._measurements(*row) for row in rows])

    def _measurements(self, values: FloatArray, weights: FloatArray, novelty: float) -> list[PoseMeasurement]:
        measurements, beyond = [], max(novelty * self.typical / self.limit, 1.0)
        for k in np.flatnonzero(weights >= _MIN_WEIGHT):
            orientation = normalise_quat(values[k, 3:])
            raw = PoseMeasurement(values[k, :3], orientation, novelty, novelty, self.regression.settings.neighbours)
            one = self.errors.apply(raw, 1 / novelty)
            # weights are shares of one answer: with more places it is not more probable that all are wrong
            odds = one.inlier_probability / (1 - one.inlier_probability) * beyond**-_DISTRUST
            odds *= float(weights[k])
            wider = replace(one, sigma_m=one.sigma_m * beyond, sigma_rad=one.sigma_rad * beyond)
            measurements.append(replace(wider, inlier_probability=odds / (1 + odds)))
        return measurements

    def state(self) -> SourceState:
        """Arrays of the regression, and its settings."""
        one, names = self.regression, ("references", "targets", "target_scale")
        arrays: dict[str, AnyArray] = {name: getattr(one, name) for name in names}
        arrays |= {"frames": self.frames, **one.projection.arrays()}
        settings = {"regression": one.settings._asdict(), "errors": asdict(self.errors)}
        limits = {"typical": self.typical, "limit": self.limit, "least_sigma_m": self.least_sigma_m}
        return SourceState(arrays, {**settings, **limits})

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored."""
        state.check(_ARRAYS, _SETTINGS)
        arrays, settings = dict(state.arrays), state.settings
        frames = arrays.pop("frames")
        projection = Projection.from_arrays(arrays.pop("offset"), arrays.pop("components"))
        regression = LocalRegression(projection, settings=LocalSettings(**settings["regression"]), **arrays)
        errors = ErrorModel.from_json(settings["errors"])
        typical, limit, least = (float(settings[name]) for name in ("typical", "limit", "least_sigma_m"))
        return cls(regression, frames, typical, limit, errors, least)
