"""Conformal regression over bins, whose prediction sets may be several disjoint intervals.

Holds bins, scores, calibrators, regions, diagnostics and a scikit-learn estimator. Works on arrays of probabilities, so
any classifier fits. Needs NumPy, SciPy and scikit-learn only.

Invalid input raises :class:`ConformodalError`, which names the argument; a prediction before calibration raises
:class:`NotCalibratedError`.
"""

from typing import TYPE_CHECKING

from conformodal.core.extras import lazy_getattr

from .bins import QuantileBins
from .calibrators.split import SplitConformal
from .diagnostics.coverage import CoverageCheck, check_coverage, coverage_band, grouped_coverage_band
from .errors import ConformodalError, SlowFitWarning, WholeRangeWarning
from .novelty import NoveltyTest
from .rank import conformal_quantile, conformal_rank, hierarchical_maximum_quantile, hierarchical_quantile
from .regions import Regions
from .scores import Aps, Density, Lac, Score, register_score

if TYPE_CHECKING:
    from .calibrators.conditional import ConditionalConformal
    from .calibrators.cross import CrossConformal
    from .calibrators.drift import DriftMonitor
    from .calibrators.mondrian import MondrianConformal
    from .calibrators.online import Aci, ConformalPid, OnlineConformal
    from .calibrators.weighted import WeightedConformal, weighted_quantile
    from .density.quick import QuickDensity
    from .density.stack import StackedDensity
    from .diagnostics.diagnosis import Diagnosis, diagnose
    from .intervals import MaxIntervals
    from .predictive import PredictiveDensity
    from .regressor import ConformalRegressor
    from .scorers import log_density, region_scorers
    from .uncalibrated import NotCalibratedError

__getattr__ = lazy_getattr(  # a camera needs none of these, and scikit-learn takes half a second to import
    __name__,
    {
        "Aci": ".calibrators.online",
        "ConditionalConformal": ".calibrators.conditional",
        "ConformalPid": ".calibrators.online",
        "ConformalRegressor": ".regressor",
        "CrossConformal": ".calibrators.cross",
        "Diagnosis": ".diagnostics.diagnosis",
        "DriftMonitor": ".calibrators.drift",
        "MaxIntervals": ".intervals",
        "MondrianConformal": ".calibrators.mondrian",
        "NotCalibratedError": ".uncalibrated",
        "OnlineConformal": ".calibrators.online",
        "PredictiveDensity": ".predictive",
        "QuickDensity": ".density.quick",
        "StackedDensity": ".density.stack",
        "WeightedConformal": ".calibrators.weighted",
        "diagnose": ".diagnostics.diagnosis",
        "log_density": ".scorers",
        "region_scorers": ".scorers",
        "weighted_quantile": ".calibrators.weighted",
    },
)

__all__ = [
    "Aci", "Aps", "ConditionalConformal", "ConformalPid", "ConformalRegressor", "ConformodalError", "CoverageCheck",
    "CrossConformal", "Density", "Diagnosis", "DriftMonitor", "Lac", "MaxIntervals", "MondrianConformal",
    "NotCalibratedError", "NoveltyTest", "OnlineConformal", "PredictiveDensity", "QuantileBins", "QuickDensity",
    "Regions", "Score", "SlowFitWarning", "SplitConformal", "StackedDensity", "WeightedConformal",
    "WholeRangeWarning", "check_coverage", "conformal_quantile", "conformal_rank", "coverage_band", "diagnose",
    "grouped_coverage_band", "hierarchical_maximum_quantile", "hierarchical_quantile", "log_density", "region_scorers",
    "register_score", "weighted_quantile",
]  # fmt: skip
