"""Whether the sources of a model score new frames as those did that calibrated it."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from conformodal.core.words import counted

_SIGMAS = 2


@dataclass(frozen=True)
class SourceComparison:
    """Held-out frames answered twice: by the sources of the model, and by sources that lacked a fold of the stretches.

    Calibration by stretches takes the scores of the latter for those of the former. Smaller errors of the former are
    not enough: if they claim an even smaller spread, their scores are larger, and their regions hold too few poses.

    Attributes
    ----------
    n_frames
        Frames that neither had seen and that show a known place.
    n_both, n_model_only, n_folds_only
        Frames whose pose is held by both regions at the model's thresholds, by that of the model's sources only, and by
        that of the others only.
    larger
        Share of frames in which the model's sources have the larger score.
    """

    n_frames: int
    n_both: int
    n_model_only: int
    n_folds_only: int
    larger: float

    @property
    def covered(self) -> tuple[float, float]:
        """Share of poses held by the regions of the model's sources, and of the others."""
        held = self.n_both + self.n_model_only, self.n_both + self.n_folds_only
        return held[0] / self.n_frames, held[1] / self.n_frames

    @property
    def too_sure(self) -> bool:
        """Whether the model's sources hold fewer poses, by more than two standard errors of independent frames."""
        return self.n_folds_only - self.n_model_only > _SIGMAS * sqrt(self.n_folds_only + self.n_model_only)

    def describe(self) -> str:
        """The comparison in a sentence."""
        model, folds = self.covered
        return (
            f"In {counted(self.n_frames, 'held-out frame')} the regions of the model's sources hold {model:.3f} of the "
            f"poses, those of sources that lacked a fold of the stretches {folds:.3f}; the scores of the former are "
            f"larger in {100 * self.larger:.0f} %"
        )
