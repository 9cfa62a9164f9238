"""Whether a recording is good enough: where it is sparse, fast or ambiguous, what it guarantees, what to record."""

from .advice import (
    WHERE,
    Names,
    describe_sharing,
    describe_units,
    record_next,
    said_of_promise,
    said_of_quality,
)
from .examining import RecordingQuality, examine, examine_training
from .place_ambiguity import Ambiguity, AmbiguousStretch
from .promise import KindPromise, least_alpha, promises
from .record import names_of, quality_record
from .settings import QUALITY, QualitySettings
from .view_coverage import FastStretch, PoseCoverage, ThinStretch, pose_coverage
from .views import ViewScale

__all__ = [
    "QUALITY",
    "WHERE",
    "Ambiguity",
    "AmbiguousStretch",
    "FastStretch",
    "KindPromise",
    "Names",
    "PoseCoverage",
    "QualitySettings",
    "RecordingQuality",
    "ThinStretch",
    "ViewScale",
    "describe_sharing",
    "describe_units",
    "examine",
    "examine_training",
    "least_alpha",
    "names_of",
    "pose_coverage",
    "promises",
    "quality_record",
    "record_next",
    "said_of_promise",
    "said_of_quality",
]
