"""Whether an image shows a known place: a conformal novelty test on the network's features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal import NoveltyTest
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.localization.settings import NOVELTY
from conformodal.vision.backbone import coarse_features


@dataclass(frozen=True, eq=False)
class PlaceNovelty:
    """The novelty test against the frames that the sources learnt from.

    Null hypothesis: the image is exchangeable with left-out frames (or stretches, or recordings) of the training data.
    The p-values are exact if the network was not trained on them.
    """

    test: NoveltyTest
    grid: tuple[int, int]  # rows and columns of the network's map

    @classmethod
    def fit(cls, features: npt.NDArray[np.float32], pieces: IntArray, grid: tuple[int, int]) -> Self | None:
        """From features (n, F), and labels (n,) of what is left out together; None for fewer than two labels."""
        if len(np.unique(pieces)) < 2:
            return None
        return cls(NoveltyTest(_descriptors(features, grid), pieces), grid)

    def p_values(self, features: npt.NDArray[np.float32]) -> FloatArray:
        """(n,) p-values of features (n, F); a small one indicates an unknown place."""
        return self.test.p_values(self.test.scores(_descriptors(features, self.grid)))

    def level(self, asked: float | None) -> float:
        """The significance level: the given one, or the default of :class:`~conformodal.model.config.ModelConfig`.

        The default is at least the smallest possible p-value, since no image is flagged below it.
        """
        if asked is not None:
            return asked
        by_frame = bool((self.test.weights_ == 1).all())
        return max(NOVELTY.level_frames if by_frame else NOVELTY.level_stretches, self.test.least_p)


def _descriptors(features: npt.NDArray[np.float32], grid: tuple[int, int]) -> npt.NDArray[np.float16]:
    """Global descriptors of references and new images, rounded alike so that an image equals itself."""
    return coarse_features(features, grid).astype(np.float16)
