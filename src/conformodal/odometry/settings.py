"""Every number that odometry was given and did not learn, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class _FoldSettings:
    """How frames are held out where stretches calibrate.

    Attributes
    ----------
    most
        Folds at most: each trains sources of its own. With five, sources learn from 80 % of what the model's own know.
    """

    most: int = 5


@dataclass(frozen=True)
class _DepthSettings:
    """How the scene's depth is learnt from training frames.

    Attributes
    ----------
    stretches, frames
        Stretches that are looked at, spread over all training frames, and frames of each.
    gap
        A gap between training frames ends a stretch where it is longer than the usual one by this factor.
    least_submaps
        Below which nothing is known of the depth.
    least_spread
        Of the logarithm of the depth: no scene is known better.
    """

    stretches: int = 10
    frames: int = 12
    gap: float = 4.0
    least_submaps: int = 5
    least_spread: float = 0.1


@dataclass(frozen=True)
class _SizingSettings:
    """How large a recording's radius is beside that of others, see :mod:`conformodal.odometry.sizing`.

    Attributes
    ----------
    metres_per_rad
        Metres of position that weigh as much as one radian, where no scene's depth is known: a pose d metres off moves
        the view of things at a depth of z metres as much as one turned by d / z radians, and rooms are some two metres
        deep. Other values: benchmarks/results/radius.md.
    reference_rad
        A recording of this roughness has size 1. A unit only: thresholds take it back.
    power
        Of roughness. Less than proportional, because only a part of an error shows in neighbouring frames: what a map
        has wrong moves all of them alike. Chosen in benchmarks/radius.py on one reference truth, and tested on another.
    least_rad
        No recording counts as smoother, so that a size is never zero.
    """

    metres_per_rad: float = 2.0
    reference_rad: float = 0.01
    power: float = 0.25
    least_rad: float = 1e-6


FOLDS, DEPTHS, SIZING = _FoldSettings(), _DepthSettings(), _SizingSettings()
