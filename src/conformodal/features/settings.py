"""Names of networks and settings of training, apart from the code that needs torch."""

from __future__ import annotations

from dataclasses import dataclass

from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import check_ranges

# Networks by name, and the block of each that gives the features: of Lite0 and Lite1 it has 80 channels, of Lite2 88.
NETWORKS = {"efficientnet_lite0": 7, "efficientnet_lite1": 10, "efficientnet_lite2": 10}
HUB_PREFIX = "hf:"  # of the names of models of transformers


class VisionError(ConformodalError):
    """A backbone, feature or training setting that cannot be used."""


def check_network(name: str) -> None:
    """Refuse a name that is none of :data:`NETWORKS` and does not begin with ``hf:``."""
    if name not in NETWORKS and not name.startswith(HUB_PREFIX):
        raise VisionError(
            f"backbone must be one of {sorted(NETWORKS)}, or {HUB_PREFIX}NAME of transformers; got {name!r}"
        )


@dataclass(frozen=True)
class TrainingConfig:
    """How a head is trained; the same for the conformal network and the classical regressor."""

    epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 3e-3  # of AdamW with a one-cycle schedule
    weight_decay: float = 1e-2
    hidden: int = 256  # units of the hidden layer
    dropout: float = 0.3
    input_dropout: float | None = None  # of the projected features; None: the same as `dropout`
    components: int | None = 256  # of the projection, see conformodal.features.head.fit_projection
    seed: int = 0  # of weights, dropout and the order of samples

    def __post_init__(self) -> None:
        check_ranges(vars(self), VisionError)
