"""Conformal calibration, from scores to thresholds: split, Mondrian (by group), weighted (covariate shift), cross."""

from .cross import CrossConformal
from .grouped import grouped_maximum_quantile, grouped_quantile
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
    "grouped_maximum_quantile",
    "grouped_quantile",
    "weighted_quantile",
]
