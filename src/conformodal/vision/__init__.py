"""Images to probabilities: frozen features, trained heads (torch)."""

from .backbone import Backbone, BackboneConfig, FeatureViews, coarse_features, feature_views, pick_device
from .errors import VisionError
from .features import FeatureCache, default_cache_dir, extract_features
from .finetuning import FineTuning, fine_tune
from .heads import Head, predict_proba, predict_values
from .networks import NETWORKS, find_network
from .projection import Projection, fit_projection
from .training import TrainingConfig, fit_head, mean_squared_error, soft_cross_entropy

__all__ = [
    "NETWORKS",
    "Backbone",
    "BackboneConfig",
    "FeatureCache",
    "FeatureViews",
    "FineTuning",
    "Head",
    "Projection",
    "TrainingConfig",
    "VisionError",
    "coarse_features",
    "default_cache_dir",
    "extract_features",
    "feature_views",
    "find_network",
    "fine_tune",
    "fit_head",
    "fit_projection",
    "mean_squared_error",
    "pick_device",
    "predict_proba",
    "predict_values",
    "soft_cross_entropy",
]
