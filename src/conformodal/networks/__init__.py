"""Networks and their training, in torch; running a trained model does not need this package.

Every name is imported when it is first used.
"""

from typing import TYPE_CHECKING, Any

from conformodal.core.extras import require_extra
from conformodal.core.lazy import lazy_getattr

if TYPE_CHECKING:
    from .exporting import exported, quantised, with_head
    from .heads import Head, Loss, fit_head, mean_squared_error, predict_values, soft_cross_entropy
    from .lite import NETWORKS, find_network
    from .torch_backbone import TorchBackbone, backbone_config, limit_threads, pick_device

__all__ = [
    "NETWORKS",
    "Head",
    "Loss",
    "TorchBackbone",
    "backbone_config",
    "exported",
    "find_network",
    "fit_head",
    "limit_threads",
    "mean_squared_error",
    "pick_device",
    "predict_values",
    "quantised",
    "soft_cross_entropy",
    "with_head",
]

_find = lazy_getattr(
    __name__,
    {
        **dict.fromkeys(("exported", "quantised", "with_head"), ".exporting"),
        **dict.fromkeys(("Head", "Loss", "fit_head", "mean_squared_error"), ".heads"),
        **dict.fromkeys(("predict_values", "soft_cross_entropy"), ".heads"),
        **dict.fromkeys(("NETWORKS", "find_network"), ".lite"),
        **dict.fromkeys(("TorchBackbone", "backbone_config", "limit_threads", "pick_device"), ".torch_backbone"),
    },
)


def __getattr__(name: str) -> Any:
    with require_extra("train", "training"):
        return _find(name)
