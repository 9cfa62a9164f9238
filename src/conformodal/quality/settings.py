"""Limits for the check of a recording: chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class QualitySettings:
    """What counts as sparse, fast and ambiguous. Shares are of the field of view, see :class:`ViewScale`."""

    # a view is sparsely covered where the nearest known one differs by more. Chosen on seeds 0 to 2 of redkitchen
    # ``blocks``: of the limits tried, it tells errors over 0.1 m from others best (benchmarks/recording_quality.py)
    sparse: float = 0.1
    # neighbouring frames that differ by more are far apart: corners leave the picture between them, and images blur.
    # Relative rotations were measured to half a degree with frames that differ by 0.12
    # (benchmarks/results/relative_motion.md, every tenth frame of redkitchen), and not beyond
    fast: float = 0.15
    bridged: int = 5  # largest number of other frames between two stretches that count as one
    apart: float = 1.0  # places of a region whose views differ by more show nothing in common: they are several
    most_looked: int = 400  # held-out frames that are localized to see how ambiguous they are, evenly spread
    most_after_training: int = 100  # the same at the end of training, which should not take much longer for it
    most_advice: int = 3
    most_share: float = 0.1  # of sparsely covered or of ambiguous frames in a recording that is good enough


QUALITY = QualitySettings()
