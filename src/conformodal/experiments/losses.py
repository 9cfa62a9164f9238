"""Losses of the networks that the conformal method is compared with; all on standardised targets (n, d)."""

from __future__ import annotations

from typing import Any

import torch

from conformodal.networks import Head

N_POSITION = 3
N_COMPONENTS = 5


class WeightedHead(Head):
    """A head with a learnt log variance for position and one for orientation."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.log_variance = torch.nn.Parameter(torch.zeros(2))


def learnt_weights_loss(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Squared errors of position and orientation, weighted by learnt variances (Kendall and Cipolla 2017, eq. 3)."""
    square = (raw - targets) ** 2
    log_variance: torch.Tensor = head.log_variance  # type: ignore[assignment]
    parts = torch.stack((square[:, :N_POSITION].mean(), square[:, N_POSITION:].mean()))
    return (parts * torch.exp(-log_variance) + log_variance).sum()


def mixture_loss(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Negative log likelihood of a mixture of diagonal normals over all targets (Bishop 1994)."""
    logits, means, log_sigma = split_mixture(raw, targets.shape[1])
    z = (targets[:, None] - means) * torch.exp(-log_sigma)
    log_density = (-0.5 * z**2 - log_sigma).sum(dim=2)
    return -torch.logsumexp(torch.log_softmax(logits, dim=1) + log_density, dim=1).mean()


def split_mixture(raw: torch.Tensor, d: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Logits (n, M), means (n, M, d) and log spreads (n, M, d), the last clipped."""
    logits, means, log_sigma = torch.split(raw, [N_COMPONENTS, N_COMPONENTS * d, N_COMPONENTS * d], dim=1)
    return logits, means.reshape(-1, N_COMPONENTS, d), log_sigma.reshape(-1, N_COMPONENTS, d).clamp(-6, 3)


def pinball_loss(levels: tuple[float, ...]) -> Any:
    """Pinball loss of quantiles `levels` for every target (Koenker and Bassett 1978)."""
    at = torch.tensor(levels)

    def loss(head: Head, raw: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        miss = targets[:, :, None] - raw.reshape(len(raw), -1, len(levels))
        return torch.maximum(at * miss, (at - 1) * miss).mean()

    loss.__qualname__ = f"pinball_loss({levels})"
    return loss
