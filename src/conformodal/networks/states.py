"""The state of a training on disk: a training that is taken up again ends bit for bit as it would have."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import torch

from conformodal.core.files import replacing

from .quiet_lightning import Callback, lightning

FILE = "last.ckpt"
_RANDOM = "random_states"
_DIGEST_BYTES = hashlib.sha256().digest_size


class KeepState(Callback):
    """Keeps the state every so many epochs: weights, optimiser, schedule, and all random numbers to come.

    Parameters
    ----------
    folder
        For the state; created if missing.
    every
        Epochs between states.
    order
        Generator of the order of samples, if there is one.
    """

    def __init__(self, folder: Path, every: int, order: torch.Generator | None) -> None:
        self.folder, self.every, self.order = folder, every, order

    def on_train_epoch_end(self, trainer: lightning.Trainer, _: lightning.LightningModule) -> None:
        """Write beside and move into place: a process that dies leaves the state before."""
        if (trainer.current_epoch + 1) % self.every == 0:
            with replacing(self.folder / FILE) as part:
                trainer.save_checkpoint(part)
                with part.open("r+b") as file:
                    digest = _digest(file.read())
                    file.write(digest)

    def on_save_checkpoint(self, _: lightning.Trainer, __: lightning.LightningModule, state: dict[str, Any]) -> None:
        """Add the random numbers to come."""
        state[_RANDOM] = {"cpu": torch.get_rng_state()}
        if torch.cuda.is_available():
            state[_RANDOM]["cuda"] = torch.cuda.get_rng_state()
        if self.order is not None:
            state[_RANDOM]["order"] = self.order.get_state()

    def on_load_checkpoint(self, _: lightning.Trainer, __: lightning.LightningModule, state: dict[str, Any]) -> None:
        """Go on with the same random numbers; the loader draws its own from them when it starts on the next epoch."""
        torch.set_rng_state(state[_RANDOM]["cpu"])
        if "cuda" in state[_RANDOM] and torch.cuda.is_available():
            torch.cuda.set_rng_state(state[_RANDOM]["cuda"])
        if self.order is not None:
            self.order.set_state(state[_RANDOM]["order"])


def kept_state(folder: Path) -> Path | None:
    """The state in a folder, or None; one that is damaged, or of other versions of the libraries, is removed."""
    path = folder / FILE
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    if _digest(content[:-_DIGEST_BYTES]) == content[-_DIGEST_BYTES:]:  # zip files may have something behind them
        return path
    path.unlink()
    return None


def _digest(content: bytes) -> bytes:
    versions = f"{torch.__version__} {lightning.__version__}"
    return hashlib.sha256(versions.encode() + content).digest()
