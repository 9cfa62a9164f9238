"""The loop behind :func:`~conformodal.networks.fine_tune`, run by Lightning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from conformodal.core import Progress
from conformodal.vision import FineTuning

from .augmentation import augment
from .loop import fit_module
from .quiet_lightning import lightning
from .shares import Order, SharedBatches
from .torch_backbone import TorchBackbone

_HEAD_RATE = 10.0
_WEIGHT_DECAY = 1e-2
_DROPOUT = 0.3


class _Tuning(lightning.LightningModule):
    def __init__(self, backbone: TorchBackbone, outputs: list[int], config: FineTuning, batches: SharedBatches) -> None:
        super().__init__()
        self.backbone, self.outputs, self.config, self.batches = backbone, outputs, config, batches
        self.head = nn.Sequential(nn.Dropout(_DROPOUT), nn.LazyLinear(sum(outputs)))

    def training_step(self, batch: list[torch.Tensor], number: int) -> torch.Tensor:
        images, labels = batch
        share = self.batches.share(number)
        self.backbone.eval()  # statistics of batch normalisation stay
        dropout, linear = self.head
        features = self.backbone(augment(images, share))
        kept = dropout(torch.ones((share.size, features.shape[1]), device=features.device))[share.rows]
        raw = linear(features * kept)
        blocks = zip(torch.split(raw, self.outputs, dim=1), torch.split(labels, self.outputs, dim=1), strict=True)
        return torch.stack([share.mean(-(t * torch.log_softmax(r, dim=1)).sum(dim=1)) for r, t in blocks]).mean()

    def configure_optimizers(self) -> Any:
        rate = self.config.learning_rate
        groups = [
            {"params": [p for p in self.backbone.parameters() if p.requires_grad], "lr": rate},
            {"params": list(self.head.parameters()), "lr": _HEAD_RATE * rate},
        ]
        optimizer = torch.optim.AdamW(groups, weight_decay=_WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            max_lr=[rate, _HEAD_RATE * rate],
            total_steps=self.config.epochs * len(self.batches),
            pct_start=0.2,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def run_tuning(
    backbone: TorchBackbone,
    images: Dataset[Any],
    outputs: list[int],
    config: FineTuning,
    folder: Path | None,
    progress: Progress | None,
    processes: int = 1,
) -> None:
    """Train the last blocks of `backbone` in place, and freeze it again."""
    size = len(images)  # type: ignore[arg-type]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        order = Order()
        order.manual_seed(config.seed)
        batches = SharedBatches(size, min(config.batch_size, size), order)
        loader: DataLoader[Any] = DataLoader(images, batch_sampler=batches, generator=order)
        module = _Tuning(backbone, outputs, config, batches)
        with torch.no_grad():  # gives the lazy layer its size
            module.head(backbone(images[0][0][None].to(backbone.device)))
        for block in backbone.blocks[-config.blocks :] if config.blocks else backbone.blocks:
            block.requires_grad_(True)
        accelerator = "gpu" if backbone.device.type == "cuda" else "cpu"
        if processes > 1:  # several processes have neither a state to go on from nor a progress bar
            folder, progress = None, None
        fit_module(
            module, loader, config.epochs, folder, progress, keep_every=1, accelerator=accelerator, processes=processes
        )
    backbone.eval().requires_grad_(False)
