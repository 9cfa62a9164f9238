"""Progress of long work."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

# called with the number of finished parts and of all parts
Progress: TypeAlias = Callable[[int, int], None]
# called with the stage first
StageProgress: TypeAlias = Callable[[str, int, int], None]


def stage_of(progress: StageProgress | None, stage: str) -> Progress | None:
    """The progress of one stage."""
    return None if progress is None else lambda done, total: progress(stage, done, total)
