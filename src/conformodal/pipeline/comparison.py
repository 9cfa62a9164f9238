"""Comparison of a model's sources with the sources of the folds, whose scores calibrated it."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from conformodal.core.words import counted

_SIGMAS = 2


@dataclass(frozen=True)
class SourceComparison:
    """Held-out frames answered twice: by the sources of the model, and by sources of the folds, each without one fold.

    Calibration by stretches assumes that the scores of both are alike. Smaller errors of the model's sources are not
    enough: if their predicted spread is too small, their scores are larger, and their regions contain too few poses.
    """

    n_frames: int  # frames that neither had seen and that show a known place
    # frames whose pose is contained in both regions, in that of the model's sources only, in the other only
    n_both: int
    n_model_only: int
    n_folds_only: int
    larger: float  # share of frames in which the model's sources have the larger score

    @property
    def covered(self) -> tuple[float, float]:
        """Share of poses in the regions of the model's sources, and in those of the folds' sources."""
        held = self.n_both + self.n_model_only, self.n_both + self.n_folds_only
        return held[0] / self.n_frames, held[1] / self.n_frames

    @property
    def too_sure(self) -> bool:
        """Whether the model's regions contain fewer poses, by more than two standard errors of independent frames."""
        return self.n_folds_only - self.n_model_only > _SIGMAS * sqrt(self.n_folds_only + self.n_model_only)

    def describe(self) -> str:
        """The comparison in a sentence."""
        model, folds = self.covered
        return (
            f"In {counted(self.n_frames, 'held-out frame')} the regions of the model's sources hold {model:.3f} of the "
            f"poses, those of sources that lacked a fold of the stretches {folds:.3f}; the scores of the former are "
            f"larger in {100 * self.larger:.0f} %"
        )
