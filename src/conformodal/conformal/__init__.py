"""Regression sets that may fall apart: bins, scores, calibration, regions, diagnostics.

Works on arrays of probabilities, so any classifier fits. Needs NumPy and SciPy only.
"""

from .bins import QuantileBins
from .calibration import SplitConformal
from .diagnostics import CoverageCheck, check_coverage, coverage_band
from .errors import ConformalError, ConformodalError, NotCalibratedError
from .rank import conformal_quantile, conformal_rank
from .regions import Regions
from .scores import Density, Lac, Score

__all__ = [
    "ConformalError",
    "ConformodalError",
    "CoverageCheck",
    "Density",
    "Lac",
    "NotCalibratedError",
    "QuantileBins",
    "Regions",
    "Score",
    "SplitConformal",
    "check_coverage",
    "conformal_quantile",
    "conformal_rank",
    "coverage_band",
]
