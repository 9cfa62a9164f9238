"""Does an image show a known place? A conformal novelty test on the network's features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.conformal import NoveltyTest
from conformodal.core.arrays import FloatArray
from conformodal.localization.settings import NOVELTY
from conformodal.vision.backbone import coarse_features


@dataclass(frozen=True, eq=False)
class PlaceNovelty:
    """Global descriptors of the frames that the sources learnt from, and their novelty scores when left out.

    Attributes
    ----------
    test
        Its null hypothesis: the image is like frames (or stretches, or recordings) of the training data that were left
        out. Its law is exact where these and the new image's are exchangeable, and the network was not trained on
        them.
    grid
        Rows and columns of the network's map, see :class:`~conformodal.vision.backbone.BackboneConfig`.
    """

    test: NoveltyTest
    grid: tuple[int, int]

    @classmethod
    def fit(
        cls, features: npt.NDArray[np.float32], pieces: npt.NDArray[np.int64], grid: tuple[int, int]
    ) -> Self | None:
        """From features (n, F) of frames, and labels (n,) of what is left out together; None for fewer than two."""
        if len(np.unique(pieces)) < 2:
            return None
        return cls(NoveltyTest(_descriptors(features, grid), pieces), grid)

    def p_values(self, features: npt.NDArray[np.float32]) -> FloatArray:
        """(n,) p-values of features (n, F); small ones speak for a place that is not known."""
        return self.test.p_values(self.test.scores(_descriptors(features, self.grid)))

    def level(self, asked: float | None) -> float:
        """The level that is asked for. A level below the least possible p-value flags no image as unknown.

        None asks for 0.015 where single frames were left out, and for 0.1 where stretches or recordings were, but at
        least for the least p-value that so few pieces can give.
        """
        if asked is not None:
            return asked
        by_frame = bool((self.test.weights_ == 1).all())
        return max(NOVELTY.level_frames if by_frame else NOVELTY.level_stretches, self.test.least_p)


def _descriptors(features: npt.NDArray[np.float32], grid: tuple[int, int]) -> npt.NDArray[np.float16]:
    """Global descriptors of references and new images: rounded alike, or a picture would differ from itself."""
    return coarse_features(features, grid).astype(np.float16)
