"""A batch that several processes share: each works on some of its rows, and together they do what one would do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import distributed
from torch.utils.data import BatchSampler, RandomSampler, Sampler


def place() -> tuple[int, int]:
    """Which of how many processes this one is."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


class BatchShare:
    """The rows of a batch that this process works on.

    Random numbers are drawn for the whole batch by every process, from the same state, so that a row's do not depend
    on how many processes there are.

    Parameters
    ----------
    size
        Rows of the whole batch. Where there are fewer rows than processes, some work on the first row, and it counts
        nothing there.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        rank, self.n_processes = place()
        self.counts = rank < size
        self.rows = slice(rank, None, self.n_processes) if self.counts else slice(0, 1)

    def of(self, draw: Callable[..., torch.Tensor], *shape: int, **options: Any) -> torch.Tensor:
        """The own rows of what `draw` makes for the whole batch, (rows, *shape)."""
        return draw((self.size, *shape), **options)[self.rows]

    def mean(self, of_rows: torch.Tensor) -> torch.Tensor:
        """What makes the mean over the whole batch if it is averaged over processes, as gradients are."""
        return of_rows.sum() * (self.n_processes * self.counts / self.size)


class Order(torch.Generator):
    """Random numbers that another process can be given.

    torch gives a generator's state to the other process in memory that is gone by the time that one looks for it.
    """

    def __reduce__(self) -> tuple[Any, tuple[bytes]]:  # type: ignore[override]
        return _restored, (self.get_state().numpy().tobytes(),)


def _restored(state: bytes) -> Order:
    order = Order()
    order.set_state(torch.frombuffer(bytearray(state), dtype=torch.uint8))
    return order


class SharedBatches(Sampler[list[int]]):
    """Batches in random order, the same for any number of processes; each process gets its rows of each batch.

    Parameters
    ----------
    n, size
        Samples, and samples a batch.
    generator
        Of the order.
    """

    def __init__(self, n: int, size: int, generator: torch.Generator) -> None:
        self.n, self.size = n, size
        self._whole = BatchSampler(RandomSampler(range(n), generator=generator), size, drop_last=False)

    def __len__(self) -> int:
        return len(self._whole)

    def __iter__(self) -> Iterator[list[int]]:
        return (batch[BatchShare(len(batch)).rows] for batch in self._whole)

    def share(self, number: int) -> BatchShare:
        """Of batch `number` of an epoch."""
        return BatchShare(min(self.size, self.n - number * self.size))
