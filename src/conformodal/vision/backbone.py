"""Frozen features that still know where in the image things are."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from conformodal.datasets import THUMBNAIL, thumbnail

from .errors import VisionError
from .networks import find_network

# Images are not enlarged, and reduced to at most this width.
MAX_WIDTH = 320
_PICTURE = THUMBNAIL[0] * THUMBNAIL[1]


class FeatureViews(NamedTuple):
    """Parts of features that can be looked at alone.

    Attributes
    ----------
    network, thumbnail, both
        Which of the F features.
    """

    network: slice
    thumbnail: slice
    both: slice


def feature_views(n_features: int) -> FeatureViews:
    """The parts of a :class:`Backbone`'s features.

    Raises
    ------
    VisionError
        If there are too few to end in a thumbnail.
    """
    cut = n_features - _PICTURE
    if cut < 1:
        raise VisionError(f"features end in a thumbnail of {_PICTURE} numbers, got {n_features} in all")
    return FeatureViews(slice(0, cut), slice(cut, n_features), slice(0, n_features))


def coarse_features(features: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The network's map (n, F) averaged over two by two cells: a global descriptor.

    The training images have no part in it, unless the network was fine-tuned on them.
    """
    rows, columns = BackboneConfig.grid
    network = features[:, feature_views(features.shape[1]).network]
    cells = network.reshape(len(features), -1, rows // 2, 2, columns // 2, 2)
    return np.asarray(cells.mean(axis=(3, 5)).reshape(len(features), -1), dtype=np.float32)


@dataclass(frozen=True)
class BackboneConfig:
    """Which features to take.

    Attributes
    ----------
    name
        Network; its ImageNet weights come with a package, no download.
    block
        Last block to run; None for the whole network but its classifier. Block 7 of Lite0 has 80 channels at a
        sixteenth of the resolution; later ones know more of what and less of where.
    width, height
        Input size in pixels.
    grid
        Rows and columns the map is averaged into. A global average, (1, 1), throws position away.
    """

    name: str = "efficientnet_lite0"
    block: int | None = 7
    width: int = 320
    height: int = 240
    grid: tuple[int, int] = (6, 8)

    @classmethod
    def for_images(
        cls, width: int, height: int, name: str = "efficientnet_lite0", *, whole: bool = False
    ) -> BackboneConfig:
        """The default features of a network for images of a size.

        `whole` asks for those that a classifier would get, as the paper does: of the whole network, averaged over the
        image.

        Raises
        ------
        VisionError
            If the network is unknown.
        """
        w = min(MAX_WIDTH, width)
        network, size = find_network(name), (w, max(1, round(height * w / width)))
        return cls(name, None, *size, grid=(1, 1)) if whole else cls(name, network.block, *size)


def pick_device(name: str) -> torch.device:
    """The device of a name: ``cpu``, ``cuda``, or ``auto`` for a graphics card where there is one.

    Raises
    ------
    VisionError
        If the name is another, or there is no such device.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise VisionError(f"device must be auto, cpu or cuda, got {name!r}")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise VisionError("device is cuda, but torch finds no graphics card it can use")
    return torch.device("cuda" if there and name != "cpu" else "cpu")


class Backbone(nn.Module):
    """A feature extractor, frozen but for fine-tuning.

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
        layers, mean, scale, identity = find_network(config.name).load(config.block)
        self._identity = hashlib.sha256(identity).digest()
        self.tuned: str | None = None  # digest of weights other than the package's
        self.register_buffer("pixel_mean", torch.tensor(mean).reshape(1, -1, 1, 1))
        self.register_buffer("pixel_scale", torch.tensor(scale).reshape(1, -1, 1, 1))
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(config.grid))
        self.eval().requires_grad_(False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return self.pixel_mean.device

    @property
    def blocks(self) -> list[nn.Module]:
        """Its parts that hold weights, first to last."""
        found: list[nn.Module] = []
        for layer in self.layers:
            if next(layer.parameters(), None) is not None:
                found += getattr(layer, "blocks", [layer])
        return found

    @property
    def fingerprint(self) -> str:
        """Digest of the weights, the configuration and the versions that decide the features."""
        digest = hashlib.sha256(self._identity)
        digest.update(repr(THUMBNAIL).encode())
        digest.update(repr(sorted(asdict(self.config).items())).encode())
        if self.tuned is not None:
            digest.update(self.tuned.encode())
        return digest.hexdigest()

    def weights(self) -> dict[str, npt.NDArray[np.generic]]:
        """All weights, by name."""
        return {k: np.ascontiguousarray(v.cpu().numpy()) for k, v in self.layers.state_dict().items()}

    def take_weights(self, weights: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Replace the packaged weights, as after fine-tuning.

        Raises
        ------
        VisionError
            If they are not this network's.
        """
        try:
            self.layers.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in weights.items()})
        except (RuntimeError, TypeError) as exc:
            raise VisionError(f"weights do not fit {self.config.name}: {exc}") from exc
        digest = hashlib.sha256()
        for name, value in sorted(weights.items()):
            digest.update(name.encode() + np.ascontiguousarray(value).tobytes())
        self.tuned = digest.hexdigest()

    def prepare(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Resize one image (h, w, 3) to the input size, averaging where it shrinks."""
        size = (self.config.width, self.config.height)
        if image.shape[1::-1] == size:
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def describe(self, images: npt.NDArray[np.uint8]) -> npt.NDArray[np.float16]:
        """Features (n, F) of prepared images (n, h, w, 3), rounded as the cache keeps them.

        The network's map, then the thumbnail: see :func:`feature_views`.
        """
        with torch.inference_mode():
            found = self(torch.tensor(images, device=self.device)).cpu().numpy()
        pictures = np.stack([thumbnail(image) for image in images]) * np.sqrt(_PICTURE)
        return np.concatenate((found, pictures), axis=1).astype(np.float16)

    def features_of(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Features (1, F) of one image (h, w, 3), the same numbers as a data set's from the cache."""
        return self.describe(self.prepare(image)[None]).astype(np.float32)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Features (n, channels * rows * columns), float32, of prepared images (n, h, w, 3), RGB in 0 to 255."""
        x = images.permute(0, 3, 1, 2).to(dtype=torch.float32)
        x = (x - self.pixel_mean) / self.pixel_scale
        features: torch.Tensor = self.layers(x).flatten(1)
        return features
