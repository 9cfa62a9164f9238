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
class _SearchSettings:
    """Prices of the search over the whole path, in nats.

    Chosen on seeds 20 and 21 of the world of turned rooms (benchmarks/turned_rooms.py reports seeds 10 to 14).

    Attributes
    ----------
    jump
        The most that one step can cost: the price of a cut, or of a gross mistake.
    followed_jump
        The same where corners were followed from one frame to the next, which rules a cut out. Images of consecutive
        frames err alike, so that their evidence, summed up, would soon pay a lower price.
    rotation_outlier
        The price of a measured relative rotation that is an outlier.
    rotation_sigma_factor
        Errors of relative rotations beside errors of candidates, over what pairs of images claim alone: rotations over
        several frames share the errors of rolling shutters and lenses. Chosen on seeds 20 and 21 of redkitchen
        `interleaved` (benchmarks/results/choices.md); one path of the corridor speaks for 1.
    own_share
        Probability that a frame which is taken for unknown keeps its own candidates; the rest is its neighbour's. A
        known place is taken for unknown with the probability of the novelty level. Chosen on the same seeds, where 0.5
        and 0.9 are alike and less is worse in the corridor.
    lag
        Frames of a stream whose answer may still change.
    """

    jump: float = 25.0
    followed_jump: float = 100.0
    rotation_outlier: float = 16.0
    rotation_sigma_factor: float = 2.0
    own_share: float = 0.5
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


CANDIDATES, SEARCH, SMOOTHER = _CandidateSettings(), _SearchSettings(), _SmootherSettings()
MOTION_PRIOR = _MotionPriorSettings()
