"""How networks are trained: settings alone, so that they can be stored and read without torch."""

from __future__ import annotations

from dataclasses import dataclass

from conformodal.core.ranges import check_ranges

from .errors import VisionError

DEVICES = ("auto", "cpu", "cuda")


def check_device(name: str) -> None:
    """Refuse a name that is none of :data:`DEVICES`; whether there is such a device is told where it is used."""
    if name not in DEVICES:
        raise VisionError(f"device must be auto, cpu or cuda, got {name!r}")


@dataclass(frozen=True)
class TrainingConfig:
    """How a head is trained; the same for the conformal network and the classical regressor.

    Attributes
    ----------
    epochs, batch_size, learning_rate, weight_decay
        Of AdamW with a one-cycle schedule.
    hidden, dropout, input_dropout
        Of the :class:`~conformodal.networks.Head`; `input_dropout` is `dropout` where it is None.
    components
        Of the projection, see :func:`~conformodal.vision.projection.fit_projection`.
    seed
        Of weights, dropout and the order of samples.
    """

    epochs: int = 100
    batch_size: int = 64
    learning_rate: float = 3e-3
    weight_decay: float = 1e-2
    hidden: int = 256
    dropout: float = 0.3
    input_dropout: float | None = None
    components: int | None = 256
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(vars(self), VisionError)
