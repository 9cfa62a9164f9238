"""Regression whose honest answer may be "here or there, not in between", and camera poses found with it.

The conformal core (``QuantileBins``, ``SplitConformal``, ``Regions``, ...) works on arrays of probabilities. What needs
torch or OpenCV (``VisualOdometry``) is imported when first used.
"""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

from .conformal import (
    ConformalError,
    ConformalRegressor,
    ConformodalError,
    CoverageCheck,
    Diagnosis,
    NotCalibratedError,
    QuantileBins,
    Regions,
    SplitConformal,
    check_coverage,
    conformal_quantile,
    conformal_rank,
    coverage_band,
    diagnose,
)

if TYPE_CHECKING:
    from .datasets import read_sevenscenes
    from .odometry import VisualOdometry
    from .poses import Trajectory
    from .report import draw_diagnosis

__version__ = metadata.version("conformodal")

_LATE = {
    "Trajectory": ".poses",
    "VisualOdometry": ".odometry",
    "draw_diagnosis": ".report",
    "read_sevenscenes": ".datasets",
}

__all__ = [
    "ConformalError",
    "ConformalRegressor",
    "ConformodalError",
    "CoverageCheck",
    "Diagnosis",
    "NotCalibratedError",
    "QuantileBins",
    "Regions",
    "SplitConformal",
    "Trajectory",
    "VisualOdometry",
    "check_coverage",
    "conformal_quantile",
    "conformal_rank",
    "coverage_band",
    "diagnose",
    "draw_diagnosis",
    "read_sevenscenes",
]


def __getattr__(name: str) -> Any:
    if name in _LATE:
        return getattr(import_module(_LATE[name], __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
