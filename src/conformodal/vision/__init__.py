"""Images to features and features to probabilities, without torch."""

from conformodal.core import needing
from conformodal.core.caching import default_cache_dir

with needing("run", "features of images"):
    import cv2  # noqa: F401
    import safetensors  # noqa: F401

from .backbone import Backbone, BackboneConfig, coarse_features, feature_views
from .errors import VisionError
from .features import FeatureCache, extract_features
from .head import SoftmaxHead
from .onnx_backbone import OnnxBackbone
from .projection import Projection, fit_projection
from .settings import TrainingConfig

__all__ = [
    "Backbone",
    "BackboneConfig",
    "FeatureCache",
    "OnnxBackbone",
    "Projection",
    "SoftmaxHead",
    "TrainingConfig",
    "VisionError",
    "coarse_features",
    "default_cache_dir",
    "extract_features",
    "feature_views",
    "fit_projection",
]
