"""Settings of training that are chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class _FoldSettings:
    """How frames are held out where stretches calibrate."""

    # Number of folds. Each needs a map, which takes most of the training time. On redkitchen `blocks` (seed 20) three
    # gave the coverage and lengths of five; in a corridor of identical rooms (benchmarks/unseen.py, seed 20, stretches)
    # regions had 2.80 m with three, 0.21 m with four and 0.19 m with five: sources that lack a third of the frames
    # take one room for another
    most: int = 4


@dataclass(frozen=True)
class _DepthSettings:
    """How the scene's depth is learnt from training frames."""

    stretches: int = 10  # spread over all training frames
    frames: int = 12  # of each stretch
    gap: float = 4.0  # a stretch ends at a gap longer than the median one by this factor
    least_submaps: int = 5  # with fewer, the depth is not known
    least_spread: float = 0.1  # standard deviation of the logarithm of the depth


@dataclass(frozen=True)
class _DisturbedSettings:
    """How many calibration frames are disturbed, at most, and the seed of kinds and strengths."""

    most: int = 200
    seed: int = 0


FOLDS, DEPTHS, DISTURBED = _FoldSettings(), _DepthSettings(), _DisturbedSettings()
