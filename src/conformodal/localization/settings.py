"""Settings of localization that are chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class _BeliefSettings:
    """How sources become one belief."""

    least_probability: float = 0.01  # of an inlier and of an outlier
    # Squared Mahalanobis distance (six degrees of freedom) up to which two estimates agree; of those that are right and
    # independent, 24 % are further apart. Larger: sources that err by more than they claim pull at better ones
    # (benchmarks/results/choices.md)
    agree: float = 8.0
    cells: int = 800  # per target, at least: estimates are more precise than bins
    # cells beyond the bins at each end, each wider than the one before by this factor: poses may be where no training
    # frame was. They reach 2.4 times as far as the 800 cells
    beyond: int = 300
    wider: float = 1.01
    recognised: float = 0.9  # inlier probability from which an estimate by local features is a recognised place
    negligible: float = 1e-3  # hypotheses of less probability are left out of the marginals


@dataclass(frozen=True)
class _ErrorModelSettings:
    """How errors of estimates are learnt."""

    least_estimates: int = 20
    outlier: float = 5.0  # standard deviations
    same_orientation_rad: float = 1.0  # an estimate rotated by more is another pose, however near
    least_distance: float = 0.005  # scene depths plus radians: nearer to known frames, errors do not shrink further
    max_growth: float = 2.0  # exponent of a power law


@dataclass(frozen=True)
class _NoveltySettings:
    """Test whether an image shows a known place.

    Default significance levels, where single frames were left out and where stretches or recordings were: the
    probability that an image of a known place is flagged. Chosen with benchmarks/novelty.py. With K stretches no
    p-value is below 1 / (K + 1), so a lower level would flag nothing.
    """

    level_frames: float = 0.015
    level_stretches: float = 0.1
    # of the level, for images in which a place was recognised
    share_recognised: float = 0.5


@dataclass(frozen=True)
class _NeighbourSettings:
    """Local regression among similar frames."""

    places: int = 4  # answers at most, one per place
    retrieved: int = 4  # frames that are clustered by place, in units of the frames of one regression
    decay: float = 2.0  # the weight of the farthest frame is exp(-decay) (Cleveland 1979)
    least_weight: float = 0.02  # of an answer
    same_place: float = 0.5  # standard deviations of the targets within which answers are of the same place
    usual: float = 0.9  # quantile of the novelty of left-out frames above which standard deviations grow with novelty
    distrust: float = 4.0  # exponent with which the odds of an inlier fall above that
    left_out: int = 800  # frames that settings are chosen on, at most
    screened: int = 200  # of these, that all settings are tried on
    finalists: int = 8  # settings that are tried on all of them


@dataclass(frozen=True)
class _LocalFeatureSettings:
    """ORB (Rublee et al. 2011)."""

    max_corners: int = 500
    levels: int = 4  # of the pyramid; with more, corners come from coarse levels and poses get worse
    blur_px: float = 1.2  # before detection: pixel noise of a sigma of 0.2 then leaves descriptors nearly unchanged
    least_width_px: int = 320  # smaller images are enlarged: descriptors look at 31 pixels around a corner
    ratio: float = 0.85  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)


@dataclass(frozen=True)
class _RetrievalSettings:
    """Place recognition by global descriptors."""

    first: int = 6  # keyframes matched in the most similar cluster
    others: int = 3  # in each of the others
    # scene depths plus radians by which keyframes of a cluster differ; 0.1 makes poses worse on fr1
    spread: float = 0.05
    clusters: int = 8  # at most
    retrieved: int = 200  # keyframes that are clustered
    radius: float = 0.5  # of a cluster, as a share of the scene's depth
    max_distance_ratio: float = 5.0  # descriptor distance of a cluster over that of the first


@dataclass(frozen=True)
class _PnpSettings:
    """Absolute poses from matches between corners and landmarks."""

    min_inliers: int = 12
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_reproj_error": 6.0, "max_iterations": 1000, "min_iterations": 50, "seed": 0}
    )
    # more iterations take long and hardly move a pose
    refinement: dict[str, Any] = field(
        default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 1.0, "max_iterations": 10}
    )
    least_residual_px: float = 0.5  # no corner is located more precisely
    corrected_by: int = 6  # keyframes whose deviations correct an estimate, weighted by one over their distance
    least_distance: float = 0.01  # added to that distance, scene depths plus radians
    same_place: float = 0.5  # share of the scene's depth within which an estimate is of the same place


@dataclass(frozen=True)
class _GuidingSettings:
    """Guided matching: landmarks of keyframes near a pose are looked for where the pose says that they are."""

    least_inliers: int = 30  # of a pose that guides; wrong poses rest on fewer
    keyframes: int = 6
    considered: int = 100  # nearest to the pose, of which those are chosen that differ
    radius_px: float = 8.0
    corners: int = 4  # nearest to a landmark that are compared with it
    most_bits: int = 64  # in which descriptors differ


@dataclass(frozen=True)
class _MappingSettings:
    """Triangulation of landmarks."""

    max_keyframes: int = 1000
    left_out: int = 100  # keyframes that the error model is learnt from
    # Keyframes whose view overlaps by more than this are hidden from a left-out one, so that hardly anything it sees is
    # mapped; and the weight of such a case.
    hidden_overlaps: tuple[float, ...] = (0.0, 0.3)
    hidden_weight: float = 0.05
    partners: int = 10  # frames in which a frame's corners are sought; pairs serve both
    most_turned_rad: float = float(np.radians(35.0))  # of partners
    usual_turn_rad: float = float(np.radians(15.0))
    # Distances of partners, in scene depths: too near gives no parallax, too far sees other things.
    nearest: float = 0.02
    best: float = 0.15
    farthest: float = 0.8
    tolerance_px: float = 4.0  # of a ray
    matches_per_pair: int = 40  # that the camera is fitted with
    min_parallax_rad: float = float(np.radians(2.5))
    iterations: int = 4  # of robust triangulation
    doubt: float = 0.4  # share of the tolerance above which residuals are downweighted


@dataclass(frozen=True)
class _CameraFitSettings:
    """Camera calibration from known poses."""

    most: int = 10000  # matches: half are fitted, half check the fit
    least: int = 400
    scale_px: float = 1.5  # of the Cauchy loss
    sigma_log_focal: float = 0.2  # prior standard deviation of the logarithm of the focal length
    sigma_mount_rad: float = 0.05  # of the mount's angles
    sigma_mount_depths: float = 0.05  # of the mount's position, in scene depths
    sigma_s: float = 0.02  # of the shutter's delays
    most_sigmas: float = 3.0  # further off, the poses do not belong to the images


@dataclass(frozen=True)
class _AdjustmentSettings:
    """Bundle adjustment of the map."""

    rounds: int = 2  # of triangulation and adjustment; sigmas and mount are learnt after each
    iterations: int = 8
    dampings: int = 8  # tried in one iteration
    enough: float = 3e-3  # share of the cost below which an iteration ends it
    # residual, as a share of the gradient, at which a step is solved, and steps of the solver. With 1e-2 to 1e-4 maps
    # localise alike
    solved: float = 1e-2
    solving: int = 300
    tracks: int = 80  # of each frame, the longest first
    least_views: int = 3
    least_per_frame: float = 20.0  # observations, on average: with fewer, poses stay as given
    # standard deviations of the given poses at first, and how far they may fall
    sigma_rad: float = float(np.radians(1.0))
    sigma_depths: float = 0.01
    least_sigma: float = 0.05
    sigma_focal: float = 0.02  # of the logarithm of the focal length


@dataclass(frozen=True)
class _OverlapSettings:
    """How two recordings are compared."""

    near_m: float = 0.3
    near_deg: float = 30.0
    keyframes: int = 150  # of the known recording, that are mapped
    images: int = 40  # of the other, that are localised
    inliers: int = 25  # distinct, that an estimate needs
    least: int = 8  # images that must agree
    agree_depths: float = 0.1  # scene depths within which motions agree
    agree_deg: float = 5.0
    # world frames differ by more than this, and by more than half of the motions that agree differ from their median
    offset_depths: float = 0.05
    offset_deg: float = 3.0


BELIEF, ERROR_MODEL, NOVELTY = _BeliefSettings(), _ErrorModelSettings(), _NoveltySettings()
NEIGHBOURS = _NeighbourSettings()
LOCAL_FEATURES, RETRIEVAL = _LocalFeatureSettings(), _RetrievalSettings()
PNP, GUIDING = _PnpSettings(), _GuidingSettings()
MAPPING, CAMERA_FIT, ADJUSTMENT = _MappingSettings(), _CameraFitSettings(), _AdjustmentSettings()
OVERLAP = _OverlapSettings()
