"""The training loop, run by Lightning: checkpoints, resuming, interruption."""

from __future__ import annotations

import hashlib
import logging
import shutil
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from torch.utils.data import BatchSampler, DataLoader, RandomSampler, TensorDataset

from .heads import Head
from .training import Loss, Progress, TrainingConfig

_CHECKPOINT_EVERY_EPOCHS = 10


class _Module(lightning.LightningModule):
    def __init__(self, head: Head, loss: Loss, config: TrainingConfig, n_steps: int) -> None:
        super().__init__()
        self.head, self.loss, self.config, self.n_steps = head, loss, config, n_steps

    def training_step(self, batch: list[torch.Tensor], _: int) -> torch.Tensor:
        x, y = batch
        return self.loss(self.head, self.head.answer(x), y)

    def configure_optimizers(self) -> Any:
        cfg = self.config
        optimizer = torch.optim.AdamW(
            self.head.parameters(), lr=cfg.learning_rate, weight_decay=cfg.weight_decay, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, max_lr=cfg.learning_rate, total_steps=self.n_steps, pct_start=0.1
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class _Report(Callback):
    def __init__(self, progress: Progress) -> None:
        self.progress = progress

    def on_train_epoch_end(self, trainer: lightning.Trainer, _: lightning.LightningModule) -> None:
        self.progress(trainer.current_epoch + 1, trainer.max_epochs or 0)


def run_loop(
    head: Head,
    x: torch.Tensor,
    y: torch.Tensor,
    loss: Loss,
    config: TrainingConfig,
    checkpoint_dir: Path | None,
    progress: Progress | None,
) -> None:
    """Fit `head` in place to projected samples (n, k) and targets; see :func:`~.training.fit_head`."""
    dataset = TensorDataset(x, y)
    order = RandomSampler(dataset, generator=torch.Generator().manual_seed(config.seed))
    # whole batches by one index operation, not sample by sample
    sampler = BatchSampler(order, min(config.batch_size, len(x)), drop_last=False)
    loader: DataLoader[Any] = DataLoader(dataset, sampler=sampler, batch_size=None)
    module = _Module(head, loss, config, config.epochs * len(sampler))
    folder = None if checkpoint_dir is None else checkpoint_dir / _digest(x, y, loss, config)
    fit_module(module, loader, config.epochs, folder, progress)


def fit_module(
    module: lightning.LightningModule,
    loader: DataLoader[Any],
    epochs: int,
    folder: Path | None,
    progress: Progress | None,
    *,
    keep_every: int = _CHECKPOINT_EVERY_EPOCHS,
    accelerator: str = "cpu",
) -> None:
    """Fit a module in place.

    Parameters
    ----------
    module, loader, epochs
        What to fit, to what and how often.
    folder
        Where its state is kept while it trains and taken up again; removed at the end. None keeps nothing.
    progress
        Called with epochs done and epochs in all.
    keep_every
        Epochs between states.
    accelerator
        Lightning's name of the device.
    """
    callbacks: list[Callback] = [] if progress is None else [_Report(progress)]
    resume = None
    if folder is not None:
        callbacks.append(ModelCheckpoint(folder, filename="last", every_n_epochs=keep_every))
        resume = folder / "last.ckpt" if (folder / "last.ckpt").is_file() else None
    with _quiet():
        trainer = lightning.Trainer(
            max_epochs=epochs,
            accelerator=accelerator,
            devices=1,
            callbacks=callbacks,
            logger=False,
            enable_checkpointing=folder is not None,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        handler = signal.getsignal(signal.SIGINT)
        try:
            trainer.fit(module, loader, ckpt_path=resume, weights_only=True)
        except SystemExit:
            if trainer.interrupted:  # Lightning turns Ctrl-C into an exit and mutes the next one; callers decide that
                raise KeyboardInterrupt from None
            raise
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, handler)
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def _digest(x: torch.Tensor, y: torch.Tensor, loss: Loss, config: TrainingConfig) -> str:
    digest = hashlib.sha256(repr((sorted(asdict(config).items()), loss.__qualname__)).encode())
    digest.update(x.numpy().tobytes())
    digest.update(y.numpy().tobytes())
    return digest.hexdigest()[:32]


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning's hints about workers, accelerators and its products are no use to someone training a small head."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric", "pytorch_lightning")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"(pytorch_)?lightning.*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
