"""Every number that reasoning was given and did not learn, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class _CandidateSettings:
    """How a softmax becomes candidate poses.

    Attributes
    ----------
    most
        Candidates of a frame.
    least_mass
        Probability below which a candidate is dropped, unless it is the most probable one. Chosen on seeds 20 and 21
        (benchmarks/results/choices.md): at 1e-4, frames without the true room make the corridor's path 4 times worse.
    valley_share
        Two peaks of a softmax are two modes where the probability between them falls below this share of the lower one.
    norm_sigma
        Standard deviation of the norm of a quaternion whose components were chosen one by one: the further from one,
        the less they fit together.
    """

    most: int = 48
    least_mass: float = 1e-6
    valley_share: float = 0.5
    norm_sigma: float = 0.1


@dataclass(frozen=True)
class _FilterSettings:
    """Of the filter over hypotheses. Chosen on seed 20 of the demo, and seeds 11, 13 and 20 of redkitchen `blocks`.

    Attributes
    ----------
    tempering
        Power to which masses of an image's belief are raised: consecutive images err alike.
    sharpness
        The same for normalisers, as a factor of `tempering`. With 1, a sharp mode of little mass that stays the same
        over many images wins over a vague hypothesis of most of the mass.
    wrong, wrong_if_unknown
        Probability that an image says nothing of the pose, where it shows a known place and where it does not. With
        0.5, a stretch of images that are all wrong alike soon had a sure path.
    jump
        Probability that the camera is anywhere in the next frame: a cut, or a gross mistake.
    followed_jump
        The same where corners were followed from one frame to the next, which rules a cut out.
    rotation_outlier
        Probability that a measured relative rotation is an outlier.
    rotation_sigma_factor
        Errors of relative rotations beside errors of hypotheses, over what pairs of images claim alone: rotations over
        several frames share the errors of rolling shutters and lenses. Chosen on seeds 20 and 21 of redkitchen
        `interleaved` (benchmarks/results/choices.md); one path of the corridor speaks for 1.
    unknown_spread, unknown_spread_rad
        Least spreads, as a share of the depth and in radians, with which an image that shows no known place goes
        into the smoother.
    least_mass
        Hypotheses of less probability are dropped.
    place, place_rad
        Hypotheses of one place are no further from its most probable one than this share of the scene's depth, and
        turned no more than this angle.
    reliable, most_reliable, sure_and_wrong
        Least probability of the chosen place with which a pose counts as reliable; training raises it, at most to
        `most_reliable`, until held-out frames with a wrong place that is so probable have at most this share.
    common
        Share of the variance of errors that consecutive images have in common; with 0, the filter is Kalman's. This and
        `wrong_if_unknown` were chosen on seeds 20 to 22 of redkitchen `blocks` and 20 of the demo.
    least_own
        Least share of the image's own belief in a region from a posterior. Chosen on the same seeds.
    lag
        Frames of a stream whose answer is revised in hindsight.
    """

    tempering: float = 0.5
    sharpness: float = 0.5
    wrong: float = 0.02
    wrong_if_unknown: float = 1 - 1e-7
    jump: float = 1e-4
    followed_jump: float = 1e-9
    rotation_outlier: float = 1e-6
    rotation_sigma_factor: float = 2.0
    unknown_spread: float = 0.2
    unknown_spread_rad: float = 0.5
    least_mass: float = 1e-7
    place: float = 0.1
    place_rad: float = 0.35
    reliable: float = 0.9
    most_reliable: float = 0.99
    sure_and_wrong: float = 0.01
    common: float = 1.0
    least_own: float = 0.02
    lag: int = 10


@dataclass(frozen=True)
class _MotionPriorSettings:
    """How speeds, turning and changes of velocity are learnt from training frames.

    Attributes
    ----------
    decimations
        Statistics are taken of every frame, every second, and so on: they differ by time step.
    top_quantile, top_factor
        Top speed: this quantile of the speeds, times this factor.
    usual_quantile
        Changes of velocity above this quantile do not count: a handful of jumps in the given poses must not loosen
        everything.
    """

    decimations: tuple[int, ...] = (1, 2, 4, 8, 16)
    top_quantile: float = 0.995
    top_factor: float = 1.1
    usual_quantile: float = 0.98


@dataclass(frozen=True)
class _SmootherSettings:
    """Of the least squares problems that smooth a path.

    Attributes
    ----------
    iterations
        At most, of each problem.
    tolerated
        Share of the scene's depth. A smaller residual of a position is never down-weighted, however small its standard
        deviation: errors that all sources and the given poses have in common are not part of it.
    submap_orientation_sigma_rad
        Standard deviation of the orientation of a whole submap.
    submap_scale_reset
        A submap whose scale leaves the expected one by more than this factor starts again from there.
    """

    iterations: int = 12
    tolerated: float = 0.01
    submap_orientation_sigma_rad: float = float(np.radians(10.0))
    submap_scale_reset: float = 5.0


CANDIDATES, FILTER, SMOOTHER = _CandidateSettings(), _FilterSettings(), _SmootherSettings()
MOTION_PRIOR = _MotionPriorSettings()
