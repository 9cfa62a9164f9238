"""Whether an image shows a known place: a conformal novelty test on the network's features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from conformodal.conformal import NoveltyTest
from conformodal.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from conformodal.features.backbone import coarse_features

from .evidence import FrameEvidence
from .settings import NOVELTY


@dataclass(frozen=True, eq=False)
class PlaceNovelty:
    """The novelty test against the frames that the sources learnt from.

    Null hypothesis: the image is exchangeable with left-out frames (or stretches, or recordings) of the training data.
    The p-values are exact if the network was not trained on them.
    """

    test: NoveltyTest  # of the image's appearance: its distance to the most similar known frame
    grid: tuple[int, int]  # rows and columns of the network's map
    # with local features: images in which a place was recognised rank below all others, the more strongly the lower, so
    # that no change of light makes them novel. Calibrated on held-out frames; None without local features
    matched: NoveltyTest | None = None
    # of disturbed images in which a place was recognised, which is harder in them; None if they are not calibrated
    disturbed: NoveltyTest | None = None

    @classmethod
    def fit(cls, features: Float32Array, pieces: IntArray, grid: tuple[int, int]) -> Self | None:
        """From features (n, F), and labels (n,) of what is left out together; None for fewer than two labels."""
        if len(np.unique(pieces)) < 2:
            return None
        return cls(NoveltyTest(coarse_features(features, grid).astype(np.float16), pieces), grid)

    def calibrated(self, distances: FloatArray, recognition: FloatArray, groups: IntArray) -> NoveltyTest:
        """A test on what held-out frames (m,), exchangeable in their groups, are like with local features."""
        return self.test.rescored(self.ranked(distances, recognition), groups)

    @staticmethod
    def ranked(distances: FloatArray, recognition: FloatArray) -> FloatArray:
        """Novelty scores of images whose local features were matched: below 0 where a place was recognised."""
        return np.where(recognition > 0, -recognition, distances)

    def disturbed_p(self, test: NoveltyTest) -> FloatArray:
        """(m,) p-values of the disturbed frames that calibrate `test`, as those of new images will be."""
        assert self.matched is not None
        return np.asarray(np.where(test.scores_ < 0, test.left_out_p_values(), self.matched.p_values(test.scores_)))

    def distances(self, evidence: FrameEvidence, left_out: IntArray | None = None) -> FloatArray:
        """(n,) distances of images to the most similar known frame, not counting those of labels `left_out` (n,)."""
        # rounded like the references, so that an image equals itself
        return self.test.scores(evidence.coarse(self.grid).astype(np.float16), left_out)

    def p_values(
        self, evidence: FrameEvidence, recognition: FloatArray | None = None, disturbed: BoolArray | bool = False
    ) -> FloatArray:
        """(n,) p-values of images; a small one indicates an unknown place.

        `recognition` (n,) is :attr:`~conformodal.localizer.belief.Beliefs.recognition`, None for appearance alone.
        `disturbed` (n,) says whether an image's quality is out of range.
        """
        distances = self.distances(evidence)
        if self.matched is None or recognition is None:
            return self.test.p_values(distances)
        scores = self.ranked(distances, recognition)
        p = self.matched.p_values(scores)
        if self.disturbed is not None:
            rows = disturbed & (recognition > 0)  # others are as novel as their appearance
            p[rows] = self.disturbed.p_values(scores[rows])
        return p

    def level(self, asked: float | None) -> float:
        """The significance level: the given one, or the default of :class:`~conformodal.pipeline.config.ModelConfig`.

        The default is at least the smallest possible p-value, since no image is flagged below it.
        """
        if asked is not None:
            return asked
        by_frame = bool((self.test.weights_ == 1).all())
        least = max(test.least_p for test in (self.test, self.matched) if test is not None)
        return max(NOVELTY.level_frames if by_frame else NOVELTY.level_stretches, least)
