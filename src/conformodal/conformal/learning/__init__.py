"""Conditional densities over bins, learnt from a table; and the scikit-learn estimator around them."""

from .quick import QuickDensity
from .regressor import ConformalRegressor
from .stacked import StackedDensity

__all__ = ["ConformalRegressor", "QuickDensity", "StackedDensity"]
