"""How far long work has come."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

# Called with what is done and what is to be done in all.
Progress: TypeAlias = Callable[[int, int], None]
# Called with the stage as well.
StageProgress: TypeAlias = Callable[[str, int, int], None]


def stage_of(progress: StageProgress | None, stage: str) -> Progress | None:
    """The progress of one stage."""
    return None if progress is None else lambda done, total: progress(stage, done, total)
