"""From an image to one belief about its pose: pose sources behind one protocol, and their fusion."""

from .belief import Beliefs, belief_cells, cells_per_bin, recognised_only
from .error_model import ErrorModel
from .errors import LocalizationError
from .evidence import FrameEvidence
from .fusion import Mixture, fuse
from .head_source import HeadSource
from .landmarks import LandmarkSource
from .local_features import LocalFeatures, Matcher, extract_local_features
from .localizer import Localizer
from .measurement import PoseMeasurement
from .neighbours import NeighbourSource
from .place_novelty import PlaceNovelty
from .source import PoseSource, SourceAnswer, SourceState, find_source, register_source
from .source_data import SourceData
from .targets import TARGET_NAMES, pose_targets, target_scale

__all__ = [
    "TARGET_NAMES",
    "Beliefs",
    "ErrorModel",
    "FrameEvidence",
    "HeadSource",
    "LandmarkSource",
    "LocalFeatures",
    "LocalizationError",
    "Localizer",
    "Matcher",
    "Mixture",
    "NeighbourSource",
    "PlaceNovelty",
    "PoseMeasurement",
    "PoseSource",
    "SourceAnswer",
    "SourceData",
    "SourceState",
    "belief_cells",
    "cells_per_bin",
    "extract_local_features",
    "find_source",
    "fuse",
    "pose_targets",
    "recognised_only",
    "register_source",
    "target_scale",
]
