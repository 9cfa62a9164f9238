"""Regression among the training frames whose global features are nearest."""

from .regression import LocalAnswers, LocalRegression, LocalSettings
from .source import NeighbourSource
from .tuning import LOCAL_CHOICES, fit_local

__all__ = [
    "LOCAL_CHOICES",
    "LocalAnswers",
    "LocalRegression",
    "LocalSettings",
    "NeighbourSource",
    "fit_local",
]
