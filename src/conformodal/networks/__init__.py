"""Networks and their training, in torch: what running a trained model does not need."""

from conformodal.core import needing

with needing("train", "training"):
    import efficientnet_lite_pytorch  # noqa: F401
    import torch  # noqa: F401

from .exporting import exported
from .finetuning import fine_tune
from .fitting import fit_head, mean_squared_error, soft_cross_entropy
from .heads import Head, Loss, predict_values
from .lite import NETWORKS, find_network
from .quantising import quantised
from .torch_backbone import TorchBackbone, backbone_config, pick_device

__all__ = [
    "NETWORKS",
    "Head",
    "Loss",
    "TorchBackbone",
    "backbone_config",
    "exported",
    "find_network",
    "fine_tune",
    "fit_head",
    "mean_squared_error",
    "pick_device",
    "predict_values",
    "quantised",
    "soft_cross_entropy",
]
