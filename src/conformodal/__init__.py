"""Regression whose honest answer may be "here or there, not in between", and camera poses found with it.

The conformal core (``QuantileBins``, ``SplitConformal``, ``Regions``, ...) works on arrays of probabilities. Every
name is imported when it is first used.
"""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

from .core.late import late

if TYPE_CHECKING:
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
    from .datasets import read_sevenscenes
    from .odometry import VisualOdometry
    from .poses import Trajectory
    from .report import draw_diagnosis

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

_find = late(__name__, {name: _LATE.get(name, ".conformal") for name in __all__})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("conformodal")
    return _find(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
