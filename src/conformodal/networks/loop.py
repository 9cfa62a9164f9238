"""The training loop, run by Lightning: checkpoints, resuming, interruption."""

from __future__ import annotations

import hashlib
import logging
import shutil
import signal
import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, TensorDataset

from conformodal.core import Progress
from conformodal.core.files import FolderInUseError, locked
from conformodal.vision import TrainingConfig

from .heads import Head, Loss
from .quiet_lightning import Callback, lightning
from .states import KeepState, kept_state

_CHECKPOINT_EVERY_EPOCHS = 10


class _Module(lightning.LightningModule):
    """One step of Lightning's is an epoch: its own work a batch would take about as long as the batch itself."""

    def __init__(self, head: Head, x: torch.Tensor, y: torch.Tensor, loss: Loss, config: TrainingConfig) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.head, self.x, self.y, self.loss, self.config = head, x, y, loss, config
        self.batch_size = min(config.batch_size, len(x))

    def training_step(self, _: list[torch.Tensor]) -> None:
        counted: Any = self.optimizers()
        schedule: Any = self.lr_schedulers()
        # of seed and epoch alone; all other random numbers are kept with the state of the training
        order = np.random.default_rng((self.config.seed, self.current_epoch)).permutation(len(self.x))
        batches = torch.split(torch.from_numpy(order), self.batch_size)
        for k, at in enumerate(batches, 1):
            # Lightning keeps no state unless it has counted a step since the last time
            optimizer = counted if k == len(batches) else counted.optimizer
            optimizer.zero_grad()
            torch.autograd.backward(self.loss(self.head, self.head.answer(self.x[at]), self.y[at]))
            optimizer.step()
            schedule.step()

    def configure_optimizers(self) -> Any:
        cfg = self.config
        optimizer = torch.optim.AdamW(
            self.head.parameters(), lr=cfg.learning_rate, weight_decay=cfg.weight_decay, fused=True
        )
        n_steps = cfg.epochs * -(-len(self.x) // self.batch_size)
        rise = 0.11 if n_steps == 10 else 0.1  # of just ten steps a tenth is a phase without length, divided by
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, max_lr=cfg.learning_rate, total_steps=n_steps, pct_start=rise
        )
        return {"optimizer": optimizer, "lr_scheduler": schedule}


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
    """Fit `head` in place to projected samples (n, k) and targets; see :func:`~.fitting.fit_head`."""
    loader: DataLoader[Any] = DataLoader(TensorDataset(torch.zeros(1)))  # epochs; the module holds the samples
    module = _Module(head, x, y, loss, config)
    folder = None if checkpoint_dir is None else checkpoint_dir / _digest(head, x, y, loss, config)
    with _one_thread():
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
    processes: int = 1,
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
    processes
        That share the work (DDP); the loader gives each its part of every batch.
    """
    with ExitStack() as stack:
        if folder is not None:
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                stack.enter_context(locked(folder.with_name(f"{folder.name}.lock")))
            except FolderInUseError:  # another process trains the same, and keeps the state
                folder = None
        _fit(module, loader, epochs, folder, progress, keep_every, accelerator, processes)
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _fit(
    module: lightning.LightningModule,
    loader: DataLoader[Any],
    epochs: int,
    folder: Path | None,
    progress: Progress | None,
    keep_every: int,
    accelerator: str,
    processes: int,
) -> None:
    callbacks: list[Callback] = []
    resume = None
    if folder is not None:
        callbacks.append(KeepState(folder, keep_every, loader.generator))
        resume = kept_state(folder)
    if progress is not None:
        callbacks.append(_Report(progress))
    with _quiet():
        trainer = lightning.Trainer(
            max_epochs=epochs,
            accelerator=accelerator,
            devices=processes,
            strategy="auto" if processes == 1 else "ddp_spawn",
            use_distributed_sampler=False,
            callbacks=callbacks,
            logger=False,
            enable_checkpointing=False,
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


def _digest(head: Head, x: torch.Tensor, y: torch.Tensor, loss: Loss, config: TrainingConfig) -> str:
    what = (sorted(asdict(config).items()), loss.__qualname__, type(head).__qualname__, head.outputs)
    digest = hashlib.sha256(repr(what).encode())
    digest.update(x.numpy().tobytes())
    digest.update(y.numpy().tobytes())
    return digest.hexdigest()[:32]


@contextmanager
def _one_thread() -> Iterator[None]:
    """A batch of a small head is too little work to share: threads that wait for each other spin, and where another
    program has a core, each batch waits for the thread that was put off. Sums come out alike on all machines, too.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


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
