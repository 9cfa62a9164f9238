"""What pose sources see of images, and what they say: absolute pose estimates with calibrated errors.

The sizes of errors and the rates of outliers are learnt from frames that were held out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.special import expit

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray, evenly_spread
from conformodal.core.ranges import Range
from conformodal.features.backbone import coarse_features
from conformodal.features.local import LocalFeatures
from conformodal.geometry import Pose
from conformodal.geometry.adjustment import MEDIAN_OF_NORM3, TAIL_OF_NORM3

MIN_ESTIMATES = 20  # that errors are learnt from
_OUTLIER = 5.0  # standard deviations
_SAME_ORIENTATION_RAD = 1.0  # an estimate rotated by more is another pose, however near
_MIN_DISTANCE = 0.005  # scene depths plus radians: nearer to known frames, errors do not shrink further
_MAX_GROWTH = 2.0  # exponent of a power law
_MAX_PAIRED = 2000  # estimates between which slopes are taken: more come with each recording that joins


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """What pose sources see of n images."""

    # (n, F) of the network, see conformodal.features.backbone.Backbone, or what computes them once they are asked for
    network: Float32Array | Callable[[], Float32Array]
    local_features: Sequence[LocalFeatures] = ()  # image by image; empty where they were not extracted
    # image by image, what the source that follows corners has told already, or None; empty: of no image
    estimates: Sequence[list[PoseMeasurement] | None] = ()
    busy: bool = False  # whether sources without local features are asked only where no place was recognised
    _coarse: dict[tuple[int, int], Float32Array] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.local_features) or len(self.features)

    @cached_property
    def features(self) -> Float32Array:
        """(n, F) of the network."""
        return self.network() if callable(self.network) else self.network

    def part(self, rows: IntArray) -> FrameEvidence:
        """That of some of the images."""
        local_features = [self.local_features[i] for i in rows.tolist()] if self.local_features else ()
        estimates = [self.estimates[i] for i in rows.tolist()] if self.estimates else ()
        return FrameEvidence(lambda: self.features[rows], local_features, estimates)

    def coarse(self, grid: tuple[int, int]) -> Float32Array:
        """(n, G) :func:`~conformodal.features.backbone.coarse_features`, computed once for all that use them."""
        if grid not in self._coarse:
            self._coarse[grid] = coarse_features(self.features, grid)
        return self._coarse[grid]

    @property
    def quality(self) -> FloatArray:
        """(n, 3) :func:`~conformodal.features.local.image_quality` of images with local features."""
        return np.array([features.quality for features in self.local_features])


class LandmarkView(NamedTuple):
    """Corners of one image that agree with a pose, and the landmarks that they show."""

    corners: IntArray  # (m,) rows of the image's local features
    landmarks: IntArray  # (m,) of the source's map
    T_world_cam: FloatArray  # (4, 4) relative to the map's origin


@dataclass(frozen=True, eq=False)
class PoseMeasurement(Pose):
    """An absolute pose estimate of one image: the camera's pose in the world, and how good the estimate is."""

    sigma_m: float  # standard deviation of its errors, per axis
    sigma_rad: float  # about each axis
    n_inliers: int  # distinct observations that agree with the pose; a corner counts once
    # probability that the estimate is not an outlier. Of several estimates by one source, at most one is right, and
    # each probability is stated as if the others were wrong
    inlier_probability: float = 1.0
    inlier_share: float = 1.0  # of the matched observations, that agree with the pose
    image_share: float = 1.0  # over which these are spread
    # to the nearest frame with a known pose, in scene depths plus radians; 0 where it is not measured
    distance_to_known: float = 0.0
    view: LandmarkView | None = None  # what it rests on, where that can be followed into the next image


@dataclass(frozen=True)
class ErrorModel:
    """Standard deviations and inlier probabilities of a source's estimates.

    The standard deviation in metres is ``position * sigma_m**position_growth * distance**position_distance``, with the
    predicted sigma and the distance from the nearest known frame; that in radians likewise. The log odds of an inlier
    are ``log_odds + slopes @ log(support)``.
    """

    position: float
    position_growth: float
    position_distance: float
    rotation: float
    rotation_growth: float
    rotation_distance: float
    log_odds: float
    slopes: tuple[float, ...]

    def apply(self, estimate: PoseMeasurement, *support: float) -> PoseMeasurement:
        """The estimate with calibrated standard deviations and inlier probability, in place of the predicted ones."""
        odds = self.log_odds + float(np.dot(self.slopes, np.log(support)))
        away = max(estimate.distance_to_known, _MIN_DISTANCE)
        return replace(
            estimate,
            sigma_m=self.position * estimate.sigma_m**self.position_growth * away**self.position_distance,
            sigma_rad=self.rotation * estimate.sigma_rad**self.rotation_growth * away**self.rotation_distance,
            inlier_probability=float(1 / (1 + np.exp(-odds))),
        )

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Self:
        """The model from its fields, as JSON stores them."""
        return cls(**{**record, "slopes": tuple(record["slopes"])})

    @staticmethod
    def json_schema(n_support: int) -> dict[str, Any]:
        """What these fields must be, see :func:`~conformodal.core.schema.check_json`."""
        power = {"": Range(0, 1e9, "(]"), "_growth": Range(0, _MAX_GROWTH), "_distance": Range(0, _MAX_GROWTH)}
        powers = {what + name: allowed for what in ("position", "rotation") for name, allowed in power.items()}
        return {**powers, "log_odds": Range(-1e3, 1e3), "slopes": [Range(0, 1e3)] * n_support}


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors (m,) of estimates of held-out frames, with what was predicted of them."""

    error_m: FloatArray
    sigma_m: FloatArray
    error_rad: FloatArray
    sigma_rad: FloatArray
    distance: FloatArray  # (m,) from the nearest known frame, scene depths plus radians; 0 where not measured
    support: FloatArray  # (m, e) positive numbers that grow with the probability of an inlier
    weights: FloatArray  # (m,) in learning that probability


def fit_error_model(errors: HeldOutErrors, same_place_m: float) -> ErrorModel | None:
    """Fit the model; None from fewer than twenty estimates near the truth.

    An estimate more than `same_place_m` off is of another place: an outlier, not an error of measurement.
    """
    near = (errors.error_m < same_place_m) & (errors.error_rad < _SAME_ORIENTATION_RAD)
    if near.sum() < MIN_ESTIMATES:
        return None
    distance = np.maximum(errors.distance, _MIN_DISTANCE)
    position = _power_law(errors.error_m[near], errors.sigma_m[near], distance[near])
    rotation = _power_law(errors.error_rad[near], errors.sigma_rad[near], distance[near])
    sigma = position[0] * errors.sigma_m ** position[1] * distance ** position[2]
    inlier = near & (errors.error_m < _OUTLIER * sigma)
    return ErrorModel(*position, *rotation, *_inlier_odds(np.log(errors.support), inlier, errors.weights))


def _power_law(errors: FloatArray, sigmas: FloatArray, distance: FloatArray) -> tuple[float, float, float]:
    """Factor, exponent of the predicted sigma, exponent of the distance, which is fitted first: it explains more."""
    by_distance = _growth(errors, distance)
    left = errors / distance**by_distance
    growth = _growth(left, sigmas)
    left = left / sigmas**growth
    factor = max(float(np.median(left)) / MEDIAN_OF_NORM3, float(np.quantile(left, 0.95)) / TAIL_OF_NORM3, 1e-6)
    return factor, growth, by_distance


def _growth(errors: FloatArray, cause: FloatArray) -> float:
    """Exponent, 0 to 2, with which errors (n,) grow with a cause (n,): the median slope of logarithms (Theil-Sen)."""
    there = np.flatnonzero((errors > 0) & (cause > 0))
    there = there[evenly_spread(len(there), _MAX_PAIRED)]
    x, y = np.log(cause[there]), np.log(errors[there])
    # scipy.stats.theilslopes takes half a second and 20 MB to import, in each process of a training
    one, other = np.triu_indices(len(x), 1)
    run, rise = x[other] - x[one], y[other] - y[one]
    slopes = rise[run != 0] / run[run != 0]
    return float(np.clip(np.median(slopes), 0, _MAX_GROWTH)) if slopes.size else 0.0


def _inlier_odds(log_support: FloatArray, inlier: BoolArray, weights: FloatArray) -> tuple[float, tuple[float, ...]]:
    """Offset and slopes of the log odds, by logistic regression with half of the slopes' square as penalty.

    Support never lowers the probability of an inlier: a negative slope would come from too few outliers. One inlier
    and one outlier are added, so that no probability is 0 or 1. scikit-learn has no such bounds, and takes a second and
    80 MB to import, in each process of a training.
    """
    middle = np.median(log_support, axis=0)
    x = np.concatenate((log_support - middle, np.zeros((2, len(middle)))))
    sign = np.where(np.concatenate((inlier, [True, False])), 1.0, -1.0)
    weights = np.concatenate((weights, [1.0, 1.0]))

    def loss(parameters: FloatArray) -> tuple[float, FloatArray]:
        offset, slopes = parameters[0], parameters[1:]
        margin = sign * (offset + x @ slopes)
        pull = weights * sign * expit(-margin)
        value = weights @ np.logaddexp(0, -margin) + slopes @ slopes / 2
        return float(value), np.concatenate(([-pull.sum()], slopes - pull @ x))

    bounds = Bounds(np.concatenate(([-np.inf], np.zeros(len(middle)))), np.full(1 + len(middle), np.inf))
    start = np.zeros(1 + len(middle))
    optimum = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-13, "gtol": 1e-7})
    offset, slopes = float(optimum.x[0]), optimum.x[1:]
    return offset - float(slopes @ middle), tuple(slopes.tolist())
