"""Training of heads on cached features: losses, and the entry to the loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from conformodal.core import Progress
from conformodal.vision import Projection, TrainingConfig, VisionError, fit_projection

from .heads import Head, Loss


def soft_cross_entropy(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean over targets of the cross-entropy with order-aware labels; `targets` is (n, sum of K_j)."""
    _same_shape(raw, targets)
    if len(set(head.outputs)) == 1:  # one call for all targets is quicker than seven
        k = head.outputs[0]
        return torch.nn.functional.cross_entropy(raw.reshape(-1, k), targets.reshape(-1, k))
    blocks = zip(head.split(raw), torch.split(targets, head.outputs, dim=1), strict=True)
    return torch.stack([torch.nn.functional.cross_entropy(r, t) for r, t in blocks]).mean()


def mean_squared_error(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """The classical regressor's loss, on standardised targets (n, d)."""
    _same_shape(raw, targets)
    return torch.nn.functional.mse_loss(raw, targets)


def _same_shape(raw: torch.Tensor, targets: torch.Tensor) -> None:
    if raw.shape != targets.shape:  # broadcasting would train on nonsense
        raise VisionError(f"targets must have the shape of the outputs, {tuple(raw.shape)}, got {tuple(targets.shape)}")


def fit_head(
    features: npt.NDArray[np.float32],
    targets: npt.NDArray[np.floating[Any]],
    outputs: list[int],
    loss: Loss,
    config: TrainingConfig,
    *,
    head_type: type[Head] = Head,
    projection: Projection | None = None,
    checkpoint_dir: Path | None = None,
    progress: Progress | None = None,
) -> Head:
    """Train a head.

    Parameters
    ----------
    features, targets
        (n, F), and (n, p) in whatever form the loss takes.
    outputs
        Outputs of each target.
    loss
        :func:`soft_cross_entropy`, :func:`mean_squared_error`, or another function of head, outputs and targets.
    config
        See :class:`~conformodal.vision.TrainingConfig`.
    head_type
        A subclass, for losses with parameters of their own.
    projection
        Of these features; fitted by default. Several heads for the same samples can share one.
    checkpoint_dir
        Where to keep the state while training. A run that was stopped goes on from there if data and settings are
        the same; when training ends, its state is removed.
    progress
        Called with epochs done and epochs in all.

    Raises
    ------
    VisionError
        If there are fewer samples than two, or shapes differ.
    """
    x = torch.from_numpy(np.ascontiguousarray(features, dtype=np.float32))
    y = torch.from_numpy(np.ascontiguousarray(targets, dtype=np.float32))
    if len(x) < 2 or len(x) != len(y):
        raise VisionError(f"training needs two samples or more, as many as targets; got {x.shape}, {y.shape}")
    from .loop import run_loop  # noqa: PLC0415 - Lightning takes seconds to import; running a model needs none of it

    through = projection or fit_projection(x.numpy(), config.components)
    input_dropout = config.dropout if config.input_dropout is None else config.input_dropout
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        head = head_type(through, outputs, config.hidden, config.dropout, input_dropout)
        run_loop(head, head.project(x), y, loss, config, checkpoint_dir, progress)
    return head.eval()
