"""Frozen features that still know where in the image things are."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from .networks import find_network

# Images are not enlarged, and reduced to at most this width.
MAX_WIDTH = 320


@dataclass(frozen=True)
class BackboneConfig:
    """Which features to take.

    Attributes
    ----------
    name
        Network; its ImageNet weights come with a package, no download.
    block
        Last block to run. Block 7 of Lite0 has 80 channels at a sixteenth of the resolution; later ones know
        more of what and less of where.
    width, height
        Input size in pixels.
    grid
        Rows and columns the map is averaged into. A global average would throw position away.
    """

    name: str = "efficientnet_lite0"
    block: int = 7
    width: int = 320
    height: int = 240
    grid: tuple[int, int] = (6, 8)

    @classmethod
    def for_images(cls, width: int, height: int, name: str = "efficientnet_lite0") -> BackboneConfig:
        """The default features of a network for images of a size.

        Raises
        ------
        VisionError
            If the network is unknown.
        """
        w = min(MAX_WIDTH, width)
        return cls(name=name, block=find_network(name).block, width=w, height=max(1, round(height * w / width)))


class Backbone(nn.Module):
    """A frozen feature extractor.

    Raises
    ------
    VisionError
        If the network is unknown, its weights are not installed, or it has no such block.
    """

    pixel_mean: torch.Tensor
    pixel_scale: torch.Tensor

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.config = config
        layers, mean, scale, self._identity = find_network(config.name).load(config.block)
        self.register_buffer("pixel_mean", torch.tensor(mean).reshape(1, -1, 1, 1))
        self.register_buffer("pixel_scale", torch.tensor(scale).reshape(1, -1, 1, 1))
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(config.grid))
        self.eval().requires_grad_(False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @cached_property
    def fingerprint(self) -> str:
        """Digest of the weights, the configuration and the versions that decide the features."""
        digest = hashlib.sha256(self._identity)
        digest.update(repr(sorted(asdict(self.config).items())).encode())
        return digest.hexdigest()

    def prepare(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Resize one image (h, w, 3) to the input size, averaging where it shrinks."""
        size = (self.config.width, self.config.height)
        if image.shape[1::-1] == size:
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features (n, channels * rows * columns), float32, of prepared images (n, h, w, 3), uint8 RGB."""
        x = images.permute(0, 3, 1, 2).to(dtype=torch.float32)
        x = (x - self.pixel_mean) / self.pixel_scale
        features: torch.Tensor = self.layers(x).flatten(1)
        return features
