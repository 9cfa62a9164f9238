"""Sources that learn from more frames without those that they have learnt from."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

from conformodal.core.arrays import IntArray
from conformodal.localizer.training_data import TrainingData


@runtime_checkable
class GrowsWithFrames(Protocol):
    """A source that keeps what it needs to learn from new recordings; others stay as they are."""

    def extended(self, data: TrainingData, numbers: IntArray, *, learn_errors: bool = True) -> Self:
        """The source with all frames of new data as well, whose `numbers` (n,) follow those of the known frames.

        Without `learn_errors`, the poses are the model's own answers, which do not tell how large errors are.
        """
        ...
