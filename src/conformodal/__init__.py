"""Regression whose honest answer may be "here or there, not in between", and camera poses found with it.

Tables: :class:`ConformalRegressor`, or :class:`QuantileBins` and :class:`SplitConformal` on probabilities of your own.
Cameras: :func:`read_recording`, :func:`train_model`, :class:`PoseModel`, :func:`open_stream`, :class:`VisualOdometry`.
Every name is imported when it is first used.
"""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

from .core.extras import lazy_getattr

if TYPE_CHECKING:
    from .conformal import (
        ConformalRegressor,
        NotCalibratedError,
        QuantileBins,
        Regions,
        SplitConformal,
        conformal_quantile,
        conformal_rank,
        coverage_band,
    )
    from .core.errors import ConformodalError
    from .geometry import Trajectory
    from .io import read_recording
    from .io.streams import open_stream
    from .pipeline.estimator import VisualOdometry
    from .pipeline.model import PoseModel
    from .pipeline.train import train_model
    from .report.tables import draw_coverage, draw_regions

__all__ = [
    "ConformalRegressor",
    "ConformodalError",
    "NotCalibratedError",
    "PoseModel",
    "QuantileBins",
    "Regions",
    "SplitConformal",
    "Trajectory",
    "VisualOdometry",
    "conformal_quantile",
    "conformal_rank",
    "coverage_band",
    "draw_coverage",
    "draw_regions",
    "open_stream",
    "read_recording",
    "train_model",
]

_MODULES = {
    "ConformodalError": ".core.errors",
    "PoseModel": ".pipeline.model",
    "Trajectory": ".geometry",
    "VisualOdometry": ".pipeline.estimator",
    "draw_coverage": ".report.tables",
    "draw_regions": ".report.tables",
    "open_stream": ".io.streams",
    "read_recording": ".io",
    "train_model": ".pipeline.train",
}
_import_name = lazy_getattr(__name__, {name: _MODULES.get(name, ".conformal") for name in __all__})


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return metadata.version("conformodal")
    return _import_name(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
