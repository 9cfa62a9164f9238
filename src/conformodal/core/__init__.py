"""Small things that every floor shares: array types, progress, robust statistics, files."""

from .arrays import BoolArray, FloatArray, IntArray, RealArray
from .extras import MissingPackageError, needing
from .progress import Progress, StageProgress, stage_of
from .robust import MAD_OF_NORMAL, MEDIAN_OF_NORM2, MEDIAN_OF_NORM3, TAIL_OF_NORM3, cauchy

__all__ = [
    "MAD_OF_NORMAL",
    "MEDIAN_OF_NORM2",
    "MEDIAN_OF_NORM3",
    "TAIL_OF_NORM3",
    "BoolArray",
    "FloatArray",
    "IntArray",
    "MissingPackageError",
    "Progress",
    "RealArray",
    "StageProgress",
    "cauchy",
    "needing",
    "stage_of",
]
