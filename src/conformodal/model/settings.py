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


FOLDS, DEPTHS = _FoldSettings(), _DepthSettings()
