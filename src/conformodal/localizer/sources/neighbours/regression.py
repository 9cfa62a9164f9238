"""Locally linear regression (Cleveland 1979) among the nearest reference samples, with one answer per place.

Among a few samples that look alike, targets are nearly linear in features. Samples that look alike may come from
several places: neighbours are clustered by their targets first, and each cluster gets a regression of its own, so that
no answer is the mean of two places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray
from conformodal.features.projection import Projection
from conformodal.localizer.errors import LocalizationError
from conformodal.localizer.settings import NEIGHBOURS

_CHUNK = 256  # queries at once: their neighbours' features are copied


@dataclass(frozen=True)
class LocalSettings:
    """Settings of the regression."""

    components: int  # leading principal components of the features
    neighbours: int  # samples of one regression
    ridge: float  # penalty on the slope, in units of the neighbours' own spread
    radius: float | None  # of a place, in units of the targets' spread; None takes all neighbours for one place


@dataclass(frozen=True, eq=False)
class LocalAnswers:
    """Estimates for m queries, one for each of up to P places."""

    values: FloatArray  # (m, P, d) targets
    weights: FloatArray  # (m, P) that sum to one; 0 for places that a query does not have
    novelty: FloatArray  # (m,) distance in features from a query to the span of its neighbours at the nearest place

    @property
    def best(self) -> FloatArray:
        """(m, d) targets of the place with the largest weight."""
        return np.asarray(self.values[np.arange(len(self.values)), self.weights.argmax(axis=1)])


@dataclass(frozen=True, eq=False)
class LocalRegression:
    """Local regression among n reference samples."""

    projection: Projection
    references: Float32Array  # (n, k) projected features
    targets: FloatArray  # (n, d)
    target_scale: FloatArray  # (d,) units of distances between targets
    settings: LocalSettings

    def __post_init__(self) -> None:
        n, d = self.targets.shape
        if self.references.ndim != 2 or len(self.references) != n or self.target_scale.shape != (d,):
            shapes = self.references.shape, self.targets.shape, self.target_scale.shape
            raise LocalizationError(f"references, targets and scale must be (n, k), (n, d) and (d,), got {shapes}")

    @property
    def size(self) -> int:
        """Number of stored values."""
        return self.references.size + self.targets.size

    def predict(self, features: Float32Array) -> LocalAnswers:
        """Estimates for features (m, F)."""
        return self.predict_projected(self.projection.apply(features))

    def predict_projected(self, queries: Float32Array, groups: tuple[AnyArray, AnyArray] | None = None) -> LocalAnswers:
        """Estimates for projected features (m, k); `groups` of queries (m,) and references (n,) hide a query's own."""
        parts = []
        for a in range(0, len(queries), _CHUNK):
            hidden = None if groups is None else groups[0][a : a + _CHUNK, None] == groups[1][None, :]
            parts.append(self._answer(queries[a : a + _CHUNK].astype(np.float64), hidden))
        if not parts:
            empty = np.empty((0, 1, self.targets.shape[1]))
            return LocalAnswers(empty, empty[:, :, 0], empty[:, 0, 0])
        return LocalAnswers(*(np.concatenate(found) for found in zip(*parts, strict=True)))

    def _answer(self, queries: FloatArray, excluded: BoolArray | None) -> tuple[FloatArray, FloatArray, FloatArray]:
        how = self.settings
        queries, known = queries[:, : how.components], self.references[:, : how.components].astype(np.float64)
        square = (known**2).sum(axis=1) - 2 * queries @ known.T + (queries**2).sum(axis=1)[:, None]
        square = np.maximum(square, 0)
        if excluded is not None:
            square[excluded] = np.inf
        crowd = min(how.neighbours * (1 if how.radius is None else NEIGHBOURS.retrieved), len(known))
        near = np.argpartition(square, crowd - 1, axis=1)[:, :crowd]
        near = np.take_along_axis(near, np.argsort(np.take_along_axis(square, near, axis=1), axis=1), axis=1)
        square = np.take_along_axis(square, near, axis=1)
        there = np.isfinite(square)
        reach = np.where(there, square, 0)[:, : how.neighbours].max(axis=1, keepdims=True)
        kernel = np.where(there, np.exp(-NEIGHBOURS.decay * np.where(there, square, 0) / np.maximum(reach, 1e-12)), 0)
        place = np.zeros_like(near) if how.radius is None else self._places(near, there, how.radius)
        n_places = 1 if how.radius is None else NEIGHBOURS.places
        values = np.zeros((len(queries), n_places, self.targets.shape[1]))
        weights = np.zeros((len(queries), n_places))
        novelty = np.zeros(len(queries))
        for p in range(n_places):
            mine = np.where(place == p, kernel, 0)
            mine[np.cumsum(mine > 0, axis=1) > how.neighbours] = 0
            weights[:, p] = mine.sum(axis=1)
            rows = np.flatnonzero(weights[:, p] > 0) if p else np.arange(len(queries))  # most have one place or two
            first = np.argsort(mine[rows] == 0, axis=1, kind="stable")[:, : how.neighbours]
            chosen = np.take_along_axis(near[rows], first, axis=1)
            values[rows, p], rest = _ridge(
                known[chosen],
                self.targets[chosen],
                np.take_along_axis(mine[rows], first, axis=1),
                queries[rows],
                how.ridge,
            )
            if p == 0:  # the place of the nearest neighbour
                novelty = rest
        total = weights.sum(axis=1, keepdims=True)
        return values, weights / np.where(total > 0, total, 1), novelty

    def _places(self, near: IntArray, there: BoolArray, radius: float) -> AnyArray:
        """(m, crowd) place of each neighbour, below 0 for none: the nearest one without a place starts the next."""
        where = self.targets[near] / self.target_scale
        place = np.where(there, -1, -2)
        for p in range(NEIGHBOURS.places):
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
    right = np.concatenate((b, cross[:, :, None]), axis=2)
    solved = np.linalg.solve(gram, right)
    values = middle + np.einsum("mn,mnd->md", cross, solved[:, :, :-1])
    rest = (offset**2).sum(axis=1) - (cross * solved[:, :, -1]).sum(axis=1)
    return values, np.sqrt(np.maximum(rest, 0))
