"""Heads on cached features: a shared trunk and one output block per target, their losses and their training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

import numpy as np
import torch
from torch import nn

from conformodal.core.arrays import Float32Array, FloatArray, RealArray
from conformodal.core.parallel import raise_if_cancelled
from conformodal.core.progress import Progress

from .head import Projection, SoftmaxHead, fit_projection
from .settings import TrainingConfig, VisionError


class _Dropout(nn.Module):
    """As torch's, whose Bernoulli numbers are slow on a CPU: they took much of a small head's training."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if not self.training or self.share == 0:
            return x
        return x * torch.rand_like(x).ge_(self.share).mul_(1 / (1 - self.share))


class Head(nn.Module):
    """Projected features, dropout, one hidden layer, and a linear output per target.

    `outputs` are those per target: K bins of a softmax each, or one number each. In training, `dropout` is the share of
    hidden units, and `input_dropout` that of projected features, which are dropped. The projection is not trained.
    """

    offset: torch.Tensor
    components: torch.Tensor

    def __init__(
        self,
        projection: Projection,
        outputs: list[int],
        hidden: int = 256,
        dropout: float = 0.3,
        input_dropout: float = 0.3,
    ) -> None:
        super().__init__()
        self.outputs = list(outputs)
        self.register_buffer("offset", torch.from_numpy(projection.offset))
        self.register_buffer("components", torch.from_numpy(projection.components))
        self.trunk = nn.Sequential(
            _Dropout(input_dropout),
            nn.Linear(projection.size, hidden),
            nn.LayerNorm(hidden),
            nn.GELU(),
            _Dropout(dropout),
        )
        self.output = nn.Linear(hidden, sum(outputs))

    def project(self, features: torch.Tensor) -> torch.Tensor:
        """Projected features (n, k) of features (n, F)."""
        centred = features - self.offset
        return centred @ self.components if self.components.ndim == 2 else centred * self.components

    def answer(self, projected: torch.Tensor) -> torch.Tensor:
        """Raw outputs (n, sum of outputs) of projected features (n, k)."""
        result: torch.Tensor = self.output(self.trunk(projected))
        return result

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Raw outputs (n, sum of outputs) of features (n, F)."""
        return self.answer(self.project(features))

    def trained(self) -> SoftmaxHead:
        """The same head in NumPy, which predicts without torch."""
        weights = {name: value.detach().numpy().copy() for name, value in self.state_dict().items()}
        return SoftmaxHead(weights, self.outputs)


# From a head, its raw outputs and the targets of a batch to one number.
Loss: TypeAlias = Callable[[Head, torch.Tensor, torch.Tensor], torch.Tensor]


def soft_cross_entropy(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean over targets of the cross-entropy with order-aware labels; `targets` is (n, sum of K_j)."""
    if len(set(head.outputs)) == 1:  # one call for all targets is quicker than seven
        k = head.outputs[0]
        return torch.nn.functional.cross_entropy(raw.reshape(-1, k), targets.reshape(-1, k))
    blocks = zip(*(torch.split(whole, head.outputs, dim=1) for whole in (raw, targets)), strict=True)
    return torch.stack([torch.nn.functional.cross_entropy(r, t) for r, t in blocks]).mean()


def mean_squared_error(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """The classical regressor's loss, on standardised targets (n, d)."""
    return torch.nn.functional.mse_loss(raw, targets)


def fit_head(
    features: Float32Array,
    targets: RealArray,
    outputs: list[int],
    loss: Loss,
    config: TrainingConfig,
    *,
    projection: Projection | None = None,
    progress: Progress | None = None,
) -> Head:
    """Train a head on features (n, F) and targets (n, p), in the form that the loss takes.

    `projection` is that of these features, by default fitted; heads of the same samples can share one.
    """
    x = torch.from_numpy(np.ascontiguousarray(features, dtype=np.float32))
    y = torch.from_numpy(np.ascontiguousarray(targets, dtype=np.float32))
    if len(x) < 2 or len(x) != len(y):
        raise VisionError(f"training needs two samples or more, as many as targets; got {x.shape}, {y.shape}")
    through = projection or fit_projection(x.numpy(), config.components)
    input_dropout = config.dropout if config.input_dropout is None else config.input_dropout
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        head = Head(through, outputs, config.hidden, config.dropout, input_dropout)
        projected = head.project(x)  # once, by all threads
        with _one_thread():
            _train(head, projected, y, loss, config, progress)
    return head.eval()


def _train(
    head: Head, x: torch.Tensor, y: torch.Tensor, loss: Loss, config: TrainingConfig, progress: Progress | None
) -> None:
    """Fit a head in place to projected samples (n, k) and targets."""
    size = min(config.batch_size, len(x))
    n_steps = config.epochs * -(-len(x) // size)
    rise = 0.11 if n_steps == 10 else 0.1  # of just ten steps a tenth is a phase without length, divided by
    rate = config.learning_rate
    optimizer = torch.optim.AdamW(head.parameters(), lr=rate, weight_decay=config.weight_decay, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=rate, total_steps=n_steps, pct_start=rise)
    for epoch in range(config.epochs):
        raise_if_cancelled()
        torch.empty((), dtype=torch.int64).random_()  # a DataLoader drew it once: seeds still give the same heads
        order = np.random.default_rng((config.seed, epoch)).permutation(len(x))
        for rows in torch.split(torch.from_numpy(order), size):
            optimizer.zero_grad()
            torch.autograd.backward(loss(head, head.answer(x[rows]), y[rows]))
            optimizer.step()
            schedule.step()
        if progress is not None:
            progress(epoch + 1, config.epochs)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Train on one thread: a batch is too small to share, and sums are the same on all machines."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def predict_values(head: Head, features: Float32Array) -> FloatArray:
    """Raw outputs (n, d): the classical regressor's standardised predictions."""
    with torch.inference_mode():
        return np.asarray(head(torch.from_numpy(features)).double().numpy())
