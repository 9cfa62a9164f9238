"""Conformal regression over bins, whose prediction sets may be several disjoint intervals.

Holds bins, scores, calibrators, regions, diagnostics and a scikit-learn estimator. Works on arrays of probabilities, so
any classifier fits. Needs NumPy, SciPy and scikit-learn only.

Invalid input raises :class:`ConformalError`, which names the argument; a prediction before calibration raises
:class:`NotCalibratedError`.
"""

from typing import TYPE_CHECKING

from conformodal.core.extras import lazy_getattr

from .bins import QuantileBins
from .calibration.conditional import ConditionalConformal
from .calibration.cross import CrossConformal
from .calibration.grouped import grouped_maximum_quantile, grouped_quantile
from .calibration.mondrian import MondrianConformal
from .calibration.split import SplitConformal
from .calibration.weighted import WeightedConformal, weighted_quantile
from .diagnostics.coverage import CoverageCheck, check_coverage, coverage_band, grouped_coverage_band
from .diagnostics.diagnosis import Diagnosis, diagnose
from .drift import DriftMonitor
from .errors import ConformalError, ConformodalError, NotCalibratedError, SlowFitWarning, WholeRangeWarning
from .intervals import MaxIntervals
from .novelty import NoveltyTest
from .online import Aci, ConformalPid, OnlineConformal
from .predictive import PredictiveDensity
from .rank import conformal_quantile, conformal_rank
from .regions import Regions
from .scores import Aps, Density, Lac, LinearDensity, Score

if TYPE_CHECKING:
    from .learning.quick import QuickDensity
    from .learning.regressor import ConformalRegressor
    from .learning.scorers import RegionScorer, region_scorers
    from .learning.stacked import StackedDensity

__getattr__ = lazy_getattr(  # scikit-learn takes half a second to import
    __name__,
    {
        "ConformalRegressor": ".learning.regressor",
        "QuickDensity": ".learning.quick",
        "RegionScorer": ".learning.scorers",
        "StackedDensity": ".learning.stacked",
        "region_scorers": ".learning.scorers",
    },
)

__all__ = [
    "Aci", "Aps", "ConditionalConformal", "ConformalError", "ConformalPid", "ConformalRegressor", "ConformodalError",
    "CoverageCheck", "CrossConformal", "Density", "Diagnosis", "DriftMonitor", "Lac", "LinearDensity", "MaxIntervals",
    "MondrianConformal", "NotCalibratedError", "NoveltyTest", "OnlineConformal", "PredictiveDensity", "QuantileBins",
    "QuickDensity", "RegionScorer", "Regions", "Score", "SlowFitWarning", "SplitConformal", "StackedDensity",
    "WeightedConformal", "WholeRangeWarning", "check_coverage", "conformal_quantile", "conformal_rank", "coverage_band",
    "diagnose", "grouped_coverage_band", "grouped_maximum_quantile", "grouped_quantile", "region_scorers",
    "weighted_quantile",
]  # fmt: skip
