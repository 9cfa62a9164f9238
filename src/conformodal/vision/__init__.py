"""Images to probabilities: frozen features, trained heads (torch)."""

from .backbone import Backbone, BackboneConfig
from .errors import VisionError
from .features import FeatureCache, default_cache_dir, extract_features
from .heads import Head, predict_proba, predict_values
from .training import TrainingConfig, fit_head, mean_squared_error, soft_cross_entropy

__all__ = [
    "Backbone",
    "BackboneConfig",
    "FeatureCache",
    "Head",
    "TrainingConfig",
    "VisionError",
    "default_cache_dir",
    "extract_features",
    "fit_head",
    "mean_squared_error",
    "predict_proba",
    "predict_values",
    "soft_cross_entropy",
]
