"""Regression whose honest answer may be "here or there, not in between", and camera poses found with it.

The conformal core (``QuantileBins``, ``SplitConformal``, ``Regions``, ...) works on arrays of probabilities. Every
name is imported when it is first used.
"""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

from conformodal.core.extras import lazy_getattr

if TYPE_CHECKING:
    from conformodal.conformal import (
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
    from conformodal.datasets import read_sevenscenes
    from conformodal.poses import Trajectory
    from conformodal.report.diagnosis import draw_diagnosis
    from conformodal.report.tables import draw_coverage, draw_regions
    from conformodal.running.estimator import VisualOdometry

_LATE = {
    "Trajectory": ".poses",
    "VisualOdometry": ".running.estimator",
    "draw_coverage": ".report.tables",
    "draw_diagnosis": ".report.diagnosis",
    "draw_regions": ".report.tables",
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
    "draw_coverage",
    "draw_diagnosis",
    "draw_regions",
    "read_sevenscenes",
]

_find = lazy_getattr(__name__, {name: _LATE.get(name, ".conformal") for name in __all__})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("conformodal")
    return _find(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
