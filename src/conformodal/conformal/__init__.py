"""Conformal regression over bins, whose prediction sets may be several disjoint intervals.

Holds bins, scores, calibrators, regions, diagnostics and a scikit-learn estimator. Works on arrays of probabilities, so
any classifier fits. Needs NumPy, SciPy and scikit-learn only.

Invalid input raises :class:`ConformodalError`, which names the argument; a prediction before calibration raises
:class:`NotCalibratedError`.
"""

from typing import TYPE_CHECKING

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import lazy_getattr

from .bins import QuantileBins
from .calibrators.split import SplitConformal
from .coverage import CoverageCheck, check_coverage, coverage_band, grouped_coverage_band
from .monitor import ExchangeabilityMartingale, unit_scores
from .novelty import NoveltyTest
from .rank import conformal_quantile, conformal_rank, hierarchical_quantile
from .regions import Regions
from .scores import Aps, Density, Interval, Lac, ScaledDensity, Score, register_score

if TYPE_CHECKING:
    from .calibrators.conditional import ConditionalConformal
    from .calibrators.mondrian import MondrianConformal
    from .calibrators.online import Aci, OnlineConformal
    from .density.named import QuickDensity, StackedDensity
    from .diagnosis import Diagnosis, diagnose
    from .doubts import DataWarning
    from .errors import NotCalibratedError
    from .predictive import PredictiveDensity
    from .regressor import ConformalRegressor

_LATE = {  # a camera needs none of these, and scikit-learn takes half a second to import
    ".calibrators.conditional": ("ConditionalConformal",),
    ".calibrators.mondrian": ("MondrianConformal",),
    ".calibrators.online": ("Aci", "OnlineConformal"),
    ".density.named": ("QuickDensity", "StackedDensity"),
    ".diagnosis": ("Diagnosis", "diagnose"),
    ".doubts": ("DataWarning",),
    ".errors": ("NotCalibratedError",),
    ".predictive": ("PredictiveDensity",),
    ".regressor": ("ConformalRegressor",),
}
__getattr__ = lazy_getattr(__name__, {name: module for module, names in _LATE.items() for name in names})

__all__ = [
    "Aci", "Aps", "ConditionalConformal", "ConformalRegressor", "ConformodalError", "CoverageCheck", "DataWarning",
    "Density", "Diagnosis", "ExchangeabilityMartingale", "Interval", "Lac", "MondrianConformal", "NotCalibratedError",
    "NoveltyTest", "OnlineConformal", "PredictiveDensity", "QuantileBins", "QuickDensity", "Regions", "ScaledDensity",
    "Score", "SplitConformal", "StackedDensity", "check_coverage", "conformal_quantile", "conformal_rank",
    "coverage_band", "diagnose", "grouped_coverage_band", "hierarchical_quantile", "register_score", "unit_scores",
]  # fmt: skip
