"""Networks in torch, and the features that are taken of them."""

from __future__ import annotations

import hashlib
from dataclasses import asdict

import cv2
import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import nn

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.core.parallel import set_thread_limit
from conformodal.features.backbone import Backbone, BackboneConfig
from conformodal.features.settings import VisionError, check_device
from conformodal.io import THUMBNAIL

from .registry import find_network

# Images are not enlarged, and reduced to at most this width.
_MAX_WIDTH = 320


def backbone_config(
    width: int, height: int, name: str = "efficientnet_lite0", *, whole: bool = False
) -> BackboneConfig:
    """The default features of a network for images of a size.

    `whole` gives those of a classifier, as in the paper: of the whole network, averaged over the image.
    """
    w = min(_MAX_WIDTH, width)
    network, size = find_network(name), (w, max(1, round(height * w / width)))
    if whole:
        return BackboneConfig(name, None, *size, grid=(1, 1))
    return BackboneConfig(name, network.block, *size)


def pick_device(name: str) -> torch.device:
    """The device ``cpu``, ``cuda``, or ``auto``: a graphics card if there is one."""
    check_device(name)
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise VisionError("device is cuda, but torch finds no graphics card it can use")
    return torch.device("cuda" if there and name != "cpu" else "cpu")


def limit_threads(threads: int) -> None:
    """Limit torch, ONNX Runtime, OpenCV and linear algebra to so many threads each, for the rest of this process."""
    set_thread_limit(threads)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    threadpool_limits(threads)


class TorchBackbone(Backbone, nn.Module):
    """A feature extractor in torch, frozen."""

    pixel_mean: torch.Tensor
    pixel_scale: torch.Tensor

    def __init__(self, config: BackboneConfig) -> None:
        nn.Module.__init__(self)
        self.config = config
        network = find_network(config.name).load(config.block)
        self._identity = hashlib.sha256(network.identity).digest()
        self.register_buffer("pixel_mean", torch.tensor(network.pixel_mean).reshape(1, -1, 1, 1))
        self.register_buffer("pixel_scale", torch.tensor(network.pixel_scale).reshape(1, -1, 1, 1))
        self.layers = nn.Sequential(*network.layers, nn.AdaptiveAvgPool2d(config.grid))
        self.eval().requires_grad_(False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return self.pixel_mean.device

    @property
    def fingerprint(self) -> str:
        """Digest of the weights, the configuration and the versions that decide the features."""
        digest = hashlib.sha256(self._identity)
        digest.update(repr(THUMBNAIL).encode())
        digest.update(repr(sorted(asdict(self.config).items())).encode())
        return digest.hexdigest()

    def maps(self, images: UInt8Array) -> Float32Array:
        """The network's features (n, channels * rows * columns) of prepared images (n, h, w, 3)."""
        with torch.inference_mode():
            return np.asarray(self(torch.tensor(images, device=self.device)).cpu().numpy())

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features (n, channels * rows * columns), float32, of prepared images (n, h, w, 3), RGB in 0 to 255."""
        x = images.permute(0, 3, 1, 2).to(dtype=torch.float32)
        x = (x - self.pixel_mean) / self.pixel_scale
        features: torch.Tensor = self.layers(x).flatten(1)
        return features
