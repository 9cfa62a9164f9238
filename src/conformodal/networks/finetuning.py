"""Fine-tuning: the last blocks of a network, or all of them, learn from the training images."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset

from conformodal.core import Progress
from conformodal.datasets import ImageError, read_image
from conformodal.vision import BackboneConfig, FeatureCache, FineTuning, VisionError
from conformodal.vision.keeping import keep_arrays, kept_arrays

from .torch_backbone import TorchBackbone


class _Images(Dataset[tuple[torch.Tensor, torch.Tensor]]):
    """Prepared images, decoded when asked for, with their labels.

    They do not know the network: torch moves the weights of one that goes to another process, under arrays that share
    their memory.
    """

    def __init__(self, files: Sequence[Path], labels: npt.NDArray[np.float32], config: BackboneConfig) -> None:
        self.files, self.labels, self.config = files, torch.from_numpy(labels), config

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> tuple[torch.Tensor, torch.Tensor]:
        image = self.config.prepare(read_image(self.files[i]))
        return torch.from_numpy(np.array(image)), self.labels[i]


def fine_tune(
    backbone: TorchBackbone,
    image_files: Sequence[Path],
    labels: npt.NDArray[np.floating[Any]],
    outputs: list[int],
    config: FineTuning,
    cache: FeatureCache,
    progress: Progress | None = None,
    processes: int = 1,
) -> TorchBackbone:
    """A copy of a network whose last blocks have learnt these images, augmented, with a temporary softmax head.

    Statistics of batch normalisation stay those of ImageNet: batches are too small for others.

    Parameters
    ----------
    backbone
        Stays as it is.
    image_files, labels
        Of the training part: n files and (n, sum of outputs) order-aware labels.
    outputs
        Bins of each target.
    config
        See :class:`FineTuning`.
    cache
        Keeps the tuned weights, and the state of a training that was stopped.
    progress
        Called with epochs done and epochs in all.
    processes
        On this machine, which share the work; the result is the same but for rounding. With more than one, no progress
        is told, and a training that is stopped begins anew. The program must guard its start by
        ``if __name__ == "__main__"``, for each process imports it.

    Raises
    ------
    VisionError
        If there are fewer images than two, no process, or as many labels as images are not given.
    ImageError
        If an image cannot be read; names the file.
    """
    y = np.ascontiguousarray(labels, dtype=np.float32)
    if len(image_files) < 2 or y.shape != (len(image_files), sum(outputs)):
        raise VisionError(
            f"fine-tuning needs two images or more and labels ({len(image_files)}, {sum(outputs)}), got {y.shape}"
        )
    if processes < 1:
        raise VisionError(f"processes must be at least 1, got {processes}")
    key = _digest(backbone, image_files, y, config)
    kept = None if cache.folder is None else cache.folder.parent / "backbones" / f"{key}.safetensors"
    tuned = TorchBackbone(backbone.config)
    found = None if kept is None else kept_arrays(kept, key)
    if found is not None:
        try:
            tuned.take_weights(found)
            return tuned.to(backbone.device)
        except VisionError:
            tuned = TorchBackbone(backbone.config)  # not of this network: tune again
    from .tuning_loop import run_tuning  # noqa: PLC0415 - Lightning takes seconds to import

    tuned.to(backbone.device)
    folder = None if cache.folder is None else cache.folder.parent / "training" / key
    run_tuning(tuned, _Images(image_files, y, backbone.config), outputs, config, folder, progress, processes)
    weights = tuned.weights()
    tuned.take_weights(weights)
    if kept is not None:
        keep_arrays(kept, key, weights)
    return tuned


def _digest(backbone: TorchBackbone, files: Sequence[Path], labels: npt.NDArray[np.float32], config: FineTuning) -> str:
    digest = hashlib.sha256(backbone.fingerprint.encode())
    digest.update(repr(sorted(asdict(config).items())).encode())
    for path in files:
        try:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        except OSError as exc:
            raise ImageError(f"{path}: image is missing or unreadable: {exc.strerror}") from exc
    digest.update(labels.tobytes())
    return digest.hexdigest()[:32]
