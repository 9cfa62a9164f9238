"""Settings of training, apart from the code that needs torch."""

from __future__ import annotations

from dataclasses import dataclass

from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import check_ranges

DEVICES = ("auto", "cpu", "cuda")
HUB_PREFIX = "hf:"  # of the names of models of transformers


class VisionError(ConformodalError):
    """A backbone, feature or training setting that cannot be used."""


def check_device(name: str) -> None:
    """Check the name of a device; whether the machine has it is checked where it is used."""
    if name not in DEVICES:
        raise VisionError(f"device must be auto, cpu or cuda, got {name!r}")


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
    components: int | None = 256  # of the projection, see conformodal.features.projection.fit_projection
    seed: int = 0  # of weights, dropout and the order of samples

    def __post_init__(self) -> None:
        check_ranges(vars(self), VisionError)
