"""Settings of the localizer that are chosen, not learnt, with their units and where they come from."""

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
    """Maps of landmarks."""

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


@dataclass(frozen=True)
class _CandidateSettings:
    """How a softmax becomes candidate poses."""

    most: int = 48  # candidates of a frame
    # probability below which a candidate is dropped, unless it is the most probable one. Chosen on seeds 20 and 21
    # (benchmarks/results/choices.md): at 1e-4, frames without the true room make the corridor's path 4 times worse
    least_mass: float = 1e-6
    # two peaks of a softmax are two modes where the probability between them falls below this share of the lower one
    valley_share: float = 0.5
    # standard deviation of the norm of a quaternion whose components were chosen one by one: the further from one, the
    # less they fit together
    norm_sigma: float = 0.1


@dataclass(frozen=True)
class _FilterSettings:
    """Of the filter. Chosen on seeds 20 and 21 of the demo, 11, 13 and 20 to 23 of redkitchen, and 20 of fr1."""

    # Images that follow each other err alike: share of an image's evidence that the one directly before has told, and
    # seconds in which this share falls by a factor of e. What is left is the power to which the masses of an image's
    # places are raised
    alike: float = 0.8
    alike_s: float = 0.25
    # the same for normalisers, as a factor of that power. With 1, a sharp mode of little mass that stays the same over
    # many images wins over a vague hypothesis of most of the mass
    sharpness: float = 0.5
    # probability that an image says nothing of the pose, where it shows a known place and where it does not. With 0.5,
    # a stretch of images that are all wrong alike soon had a sure path
    wrong: float = 0.02
    wrong_if_unknown: float = 1 - 1e-7
    jump: float = 1e-4  # probability that the camera is anywhere in the next frame: a cut, or a gross mistake
    # the same where corners were followed from one frame to the next, which rules a cut out. With 1e-9, a path that a
    # few wrong images had led away came back after a dozen right ones
    followed_jump: float = 1e-6
    rotation_outlier: float = 1e-6  # probability that a measured relative rotation is an outlier
    # errors of relative rotations beside errors of hypotheses, over what pairs of images claim alone: rotations over
    # several frames share the errors of rolling shutters and lenses. Chosen on seeds 20 and 21 of redkitchen
    # `interleaved` (benchmarks/results/choices.md); one path of the corridor speaks for 1
    rotation_sigma_factor: float = 2.0
    # least spreads, as a share of the depth and in radians, with which an image that shows no known place goes into the
    # smoother
    unknown_spread: float = 0.2
    unknown_spread_rad: float = 0.5
    least_mass: float = 1e-10  # hypotheses of less probability are dropped
    from_image: int = 4  # most probable hypotheses of the newest image that stay beside those of the largest mass
    # hypotheses of one place are no further from its most probable one than this share of the scene's depth, and turned
    # no more than this angle
    place: float = 0.1
    place_rad: float = 0.35
    # least probability of the chosen place with which a pose counts as reliable; training raises it, at most to
    # `most_reliable`, until held-out frames with a wrong place that is so probable have at most this share
    reliable: float = 0.9
    most_reliable: float = 0.99
    sure_and_wrong: float = 0.01
    # share of the variance of errors that consecutive images have in common; with 0, the filter is Kalman's. This,
    # `wrong_if_unknown` and `least_own` were chosen on seeds 20 to 22 of redkitchen `blocks` and 20 of the demo
    common: float = 1.0
    least_own: float = 0.02  # least share of the image's own belief in a region from a posterior
    lag: int = 10  # frames of a stream whose answer is revised in hindsight
    lagged: int = 200  # held-out frames that calibrate regions at this lag, about: each takes `lag` steps


@dataclass(frozen=True)
class _MotionPriorSettings:
    """How speeds, turning and changes of velocity are learnt from training frames."""

    # statistics are taken of every frame, every second, and so on: they differ by time step
    decimations: tuple[int, ...] = (1, 2, 4, 8, 16)
    top_quantile: float = 0.995  # top speed: this quantile of the speeds, times this factor
    top_factor: float = 1.1
    # changes of velocity above this quantile do not count: a handful of jumps in the given poses must not loosen
    # everything
    usual_quantile: float = 0.98


@dataclass(frozen=True)
class _SmootherSettings:
    """Of the least squares problems that smooth a path."""

    iterations: int = 12  # at most, of each problem
    # share of the scene's depth. A smaller residual of a position is never down-weighted, however small its standard
    # deviation: errors that all sources and the given poses have in common are not part of it
    tolerated: float = 0.01
    # standard deviation of the orientation of a whole submap
    submap_orientation_sigma_rad: float = float(np.radians(10.0))
    # A submap whose scale leaves the expected one by more than this factor starts again from there
    submap_scale_reset: float = 5.0


BELIEF, ERROR_MODEL, NOVELTY = _BeliefSettings(), _ErrorModelSettings(), _NoveltySettings()
NEIGHBOURS, RETRIEVAL = _NeighbourSettings(), _RetrievalSettings()
PNP, GUIDING = _PnpSettings(), _GuidingSettings()
MAPPING = _MappingSettings()
OVERLAP = _OverlapSettings()
CANDIDATES, FILTER, SMOOTHER = _CandidateSettings(), _FilterSettings(), _SmootherSettings()
MOTION_PRIOR = _MotionPriorSettings()
