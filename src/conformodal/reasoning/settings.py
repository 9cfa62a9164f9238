"""Every number that reasoning was given and did not learn, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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


CANDIDATES, FILTER, SMOOTHER = _CandidateSettings(), _FilterSettings(), _SmootherSettings()
MOTION_PRIOR = _MotionPriorSettings()
