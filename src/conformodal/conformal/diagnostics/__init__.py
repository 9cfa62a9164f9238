"""Diagnostics of a calibration: coverage, set sizes and p-values, compared with their exact distributions."""

from .coverage import (
    CoverageCheck,
    check_coverage,
    coverage_band,
    coverage_by_group,
    coverage_by_size,
    grouped_coverage_band,
)
from .diagnosis import Diagnosis, SizeSummary, diagnose, summarise_sizes
from .slab import SlabCheck, worst_slab
from .uniformity import UniformityCheck, check_uniformity

__all__ = [
    "CoverageCheck",
    "Diagnosis",
    "SizeSummary",
    "SlabCheck",
    "UniformityCheck",
    "check_coverage",
    "check_uniformity",
    "coverage_band",
    "coverage_by_group",
    "coverage_by_size",
    "diagnose",
    "grouped_coverage_band",
    "summarise_sizes",
    "worst_slab",
]
