"""Regression whose honest answer may be "here or there, not in between", and camera poses found with it.

The conformal core (``QuantileBins``, ``SplitConformal``, ``Regions``, ...) works on arrays of probabilities. Every
name is imported when it is first used.
"""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

from .core.extras import lazy_getattr

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
    from .geometry import Trajectory
    from .io import read_sevenscenes
    from .pipeline.estimator import VisualOdometry
    from .report.diagnosis import draw_diagnosis
    from .report.tables import draw_coverage, draw_regions

_LATE = {
    "Trajectory": ".geometry",
    "VisualOdometry": ".pipeline.estimator",
    "draw_coverage": ".report.tables",
    "draw_diagnosis": ".report.diagnosis",
    "draw_regions": ".report.tables",
    "read_sevenscenes": ".io",
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
