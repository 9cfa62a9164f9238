"""What a network offers that features can be taken from."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from torch import nn


class LoadedLayers(NamedTuple):
    """Layers, the mean and scale of the pixels in 0 to 255 that they expect, and bytes that tell their weights."""

    layers: list[nn.Module]
    pixel_mean: tuple[float, ...]
    pixel_scale: tuple[float, ...]
    identity: bytes


class Network(Protocol):
    """A network by name; its weights are read when it is loaded."""

    @property
    def block(self) -> int:
        """The block to take features from, by default."""
        ...

    def load(self, block: int | None) -> LoadedLayers:
        """Layers up to a block; None for all but the classifier."""
        ...
