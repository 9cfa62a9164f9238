"""Turning scores into thresholds that keep a promise: split, by group, under covariate shift, over folds."""

from .cross import CrossConformal
from .joint import Joint, as_joint
from .mondrian import MondrianConformal
from .split import SplitConformal
from .weighted import WeightedConformal, weighted_quantile

__all__ = [
    "CrossConformal",
    "Joint",
    "MondrianConformal",
    "SplitConformal",
    "WeightedConformal",
    "as_joint",
    "weighted_quantile",
]
