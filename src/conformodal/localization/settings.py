"""Every number that localization was given and did not learn, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class _BeliefSettings:
    """How sources become one belief.

    Attributes
    ----------
    least_probability
        Of an inlier and of an outlier: no estimate is either for sure.
    alone
        Prior probability that an inlier of a later source agrees with no estimate of an earlier one. Values from 0.01
        to 0.2 give nearly the same on seeds 20 and 21 (benchmarks/results/choices.md).
    cells
        The bins of a target are cut into so many cells at least: estimates are finer than bins.
    beyond
        Cells reach beyond the bins by this share of their number: estimates may lie where no training frame was.
    recognised
        Inlier probability from which an estimate by local features is a recognised place.
    negligible
        Probability below which a hypothesis is counted to the softmax.
    """

    least_probability: float = 0.01
    alone: float = 0.05
    cells: int = 800
    beyond: float = 0.5
    recognised: float = 0.9
    negligible: float = 1e-3


@dataclass(frozen=True)
class _ErrorModelSettings:
    """How errors of estimates are learnt.

    Attributes
    ----------
    least_estimates
        That a model is learnt from.
    outlier
        Standard deviations beyond which an estimate is an outlier.
    same_orientation_rad
        An estimate rotated by more is another pose, however near.
    least_distance
        Scene depths plus radians below which errors do not depend on the distance from known frames any more.
    max_growth
        Of errors, as a power of what predicts them.
    """

    least_estimates: int = 20
    outlier: float = 5.0
    same_orientation_rad: float = 1.0
    least_distance: float = 0.005
    max_growth: float = 2.0


@dataclass(frozen=True)
class _NoveltySettings:
    """Of the test whether an image shows a known place.

    Attributes
    ----------
    level_frames, level_stretches
        Default levels, where single frames were left out and where stretches or recordings were: the probability that
        an image of a known place is taken for unknown. Chosen with benchmarks/novelty.py. With K stretches no p-value
        is below 1 / (K + 1), so a lower level would reject nothing.
    """

    level_frames: float = 0.015
    level_stretches: float = 0.1


@dataclass(frozen=True)
class _NeighbourSettings:
    """Of local regression among similar frames.

    Attributes
    ----------
    places
        Answers at most, one a place.
    retrieved
        Frames that are clustered by place, in units of the frames of one regression.
    decay
        The weight of the farthest frame is exp of minus this (Cleveland 1979).
    least_weight
        Of a place's answer.
    same_place
        Standard deviations of the targets within which answers are of the same place.
    usual
        Quantile of the novelty of left-out frames beyond which standard deviations grow in proportion to novelty.
    distrust
        Power of novelty beyond that with which the odds of an inlier fall.
    left_out
        Frames that settings are chosen on, at most.
    """

    places: int = 4
    retrieved: int = 4
    decay: float = 2.0
    least_weight: float = 0.02
    same_place: float = 0.5
    usual: float = 0.9
    distrust: float = 4.0
    left_out: int = 800


@dataclass(frozen=True)
class _LocalFeatureSettings:
    """Of ORB (Rublee et al. 2011).

    Attributes
    ----------
    max_corners, levels
        Of an image and its pyramid; with more levels, corners come from coarse ones and poses get worse.
    blur_px
        Before corners are sought: pixel noise of a sigma of 0.2 then leaves descriptors nearly unchanged.
    least_width_px
        Smaller images are enlarged to it: descriptors look at 31 pixels around a corner.
    ratio
        The nearest descriptor must be nearer than this share of the second nearest (Lowe 2004).
    """

    max_corners: int = 500
    levels: int = 4
    blur_px: float = 1.2
    least_width_px: int = 320
    ratio: float = 0.85


@dataclass(frozen=True)
class _RetrievalSettings:
    """Place recognition by global descriptors.

    Attributes
    ----------
    first, others, clusters
        Keyframes matched in the first cluster and in each of the others, and clusters at most.
    retrieved
        Keyframes that are clustered.
    radius
        Of a cluster, as a share of the scene's depth.
    max_distance_ratio
        Descriptor distance, over that of the first cluster, above which a cluster is dropped.
    """

    first: int = 6
    others: int = 3
    clusters: int = 8
    retrieved: int = 200
    radius: float = 0.5
    max_distance_ratio: float = 5.0


@dataclass(frozen=True)
class _PnpSettings:
    """Absolute poses from matches between corners and landmarks.

    Attributes
    ----------
    min_inliers
        Below which there is no estimate.
    ransac, refinement
        Of PoseLib; more refinement takes long and hardly moves a pose.
    least_residual_px
        No corner is located better.
    corrected_by, least_distance
        Keyframes whose own errors correct an estimate, weighed by one over their distance (scene depths plus radians),
        which is at least the second number.
    correctable
        Share of the scene's depth above which a keyframe's own error is an outlier.
    same_place
        Share of the scene's depth within which an estimate is of the same place, and its standard deviation useful.
    """

    min_inliers: int = 12
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_reproj_error": 6.0, "max_iterations": 1000, "min_iterations": 50, "seed": 0}
    )
    refinement: dict[str, Any] = field(
        default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 1.0, "max_iterations": 10}
    )
    least_residual_px: float = 0.5
    corrected_by: int = 6
    least_distance: float = 0.01
    correctable: float = 0.05
    same_place: float = 0.5


@dataclass(frozen=True)
class _MappingSettings:
    """Triangulation of landmarks.

    Attributes
    ----------
    max_keyframes
        Of a map.
    left_out
        Keyframes that the errors are learnt from.
    hidden_overlaps, hidden_weight
        Overlaps of view above which keyframes are hidden from a left-out one, so that it sees next to nothing that is
        mapped; and how much such a case weighs.
    partners
        Frames in which a frame's corners are sought; pairs serve both.
    most_turned_rad, usual_turn_rad
        Of partners.
    nearest, best, farthest
        Distances of partners, in scene depths: too near says nothing of depths, too far sees other things.
    tolerance_px
        Of a ray.
    matches_a_pair
        That the camera is fitted with.
    min_parallax_rad
        Between two rays of a landmark.
    iterations, doubt
        Of robust triangulation; residuals beyond this share of the tolerance lose their pull.
    """

    max_keyframes: int = 1000
    left_out: int = 100
    hidden_overlaps: tuple[float, ...] = (0.0, 0.3)
    hidden_weight: float = 0.05
    partners: int = 10
    most_turned_rad: float = float(np.radians(35.0))
    usual_turn_rad: float = float(np.radians(15.0))
    nearest: float = 0.02
    best: float = 0.15
    farthest: float = 0.8
    tolerance_px: float = 4.0
    matches_a_pair: int = 40
    min_parallax_rad: float = float(np.radians(2.5))
    iterations: int = 4
    doubt: float = 0.4


@dataclass(frozen=True)
class _CameraFitSettings:
    """Of the camera's calibration from given poses.

    Attributes
    ----------
    most, least
        Matches that are fitted.
    scale_px
        Residuals beyond lose their pull (Cauchy).
    sigma_log_focal, sigma_mount_rad, sigma_mount_depths
        Prior standard deviations of the logarithm of the focal length, and of the mount's angles and position (scene
        depths).
    most_sigmas
        A camera further off comes from poses that do not belong to the images.
    """

    most: int = 40000
    least: int = 400
    scale_px: float = 1.5
    sigma_log_focal: float = 0.2
    sigma_mount_rad: float = 0.05
    sigma_mount_depths: float = 0.05
    most_sigmas: float = 3.0


BELIEF, ERROR_MODEL, NOVELTY = _BeliefSettings(), _ErrorModelSettings(), _NoveltySettings()
NEIGHBOURS = _NeighbourSettings()
LOCAL_FEATURES, RETRIEVAL, PNP = _LocalFeatureSettings(), _RetrievalSettings(), _PnpSettings()
MAPPING, CAMERA_FIT = _MappingSettings(), _CameraFitSettings()
