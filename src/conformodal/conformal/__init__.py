"""Conformal regression over bins, whose prediction sets may be several disjoint intervals.

Holds bins, scores, calibrators, regions, diagnostics and a scikit-learn estimator. Works on arrays of probabilities, so
any classifier fits. Needs NumPy, SciPy and scikit-learn only.

Invalid input raises :class:`ConformodalError`, which names the argument; a prediction before calibration raises
:class:`NotCalibratedError`.
"""

from typing import TYPE_CHECKING

from conformodal.core.extras import lazy_getattr

from .bins import QuantileBins
from .calibrators.conditional import ConditionalConformal
from .calibrators.cross import CrossConformal
from .calibrators.drift import DriftMonitor
from .calibrators.mondrian import MondrianConformal
from .calibrators.online import Aci, ConformalPid, OnlineConformal
from .calibrators.split import SplitConformal
from .calibrators.weighted import WeightedConformal, weighted_quantile
from .diagnostics.coverage import CoverageCheck, check_coverage, coverage_band, grouped_coverage_band
from .diagnostics.diagnosis import Diagnosis, diagnose
from .errors import ConformodalError, SlowFitWarning, WholeRangeWarning
from .intervals import MaxIntervals
from .novelty import NoveltyTest
from .predictive import PredictiveDensity
from .rank import conformal_quantile, conformal_rank, hierarchical_maximum_quantile, hierarchical_quantile
from .regions import Regions
from .scores import Aps, Density, Lac, Score, register_score

if TYPE_CHECKING:
    from .density.quick import QuickDensity
    from .density.stack import StackedDensity
    from .regressor import ConformalRegressor
    from .scorers import RegionScorer, log_density, region_scorers
    from .uncalibrated import NotCalibratedError

__getattr__ = lazy_getattr(  # scikit-learn takes half a second to import
    __name__,
    {
        "ConformalRegressor": ".regressor",
        "NotCalibratedError": ".uncalibrated",
        "QuickDensity": ".density.quick",
        "RegionScorer": ".scorers",
        "StackedDensity": ".density.stack",
        "log_density": ".scorers",
        "region_scorers": ".scorers",
    },
)

__all__ = [
    "Aci", "Aps", "ConditionalConformal", "ConformalPid", "ConformalRegressor", "ConformodalError", "CoverageCheck",
    "CrossConformal", "Density", "Diagnosis", "DriftMonitor", "Lac", "MaxIntervals", "MondrianConformal",
    "NotCalibratedError", "NoveltyTest", "OnlineConformal", "PredictiveDensity", "QuantileBins", "QuickDensity",
    "RegionScorer", "Regions", "Score", "SlowFitWarning", "SplitConformal", "StackedDensity", "WeightedConformal",
    "WholeRangeWarning", "check_coverage", "conformal_quantile", "conformal_rank", "coverage_band", "diagnose",
    "grouped_coverage_band", "hierarchical_maximum_quantile", "hierarchical_quantile", "log_density", "region_scorers",
    "register_score", "weighted_quantile",
]  # fmt: skip
