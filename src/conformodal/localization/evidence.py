"""What pose sources see of an image: features of the network and, where they were extracted, local features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, Float32Array, FloatArray

from .errors import LocalizationError
from .image_quality import NOT_MEASURED
from .local_features import LocalFeatures


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """What pose sources see of n images.

    Attributes
    ----------
    features
        (n, F) of the network, see :class:`~conformodal.vision.backbone.Backbone`.
    local_features
        Image by image; None where they were not extracted.
    """

    features: Float32Array
    local_features: Sequence[LocalFeatures | None] = ()

    def __post_init__(self) -> None:
        if len(self.local_features) not in (0, len(self.features)):
            raise LocalizationError(
                f"{len(self.features)} images need as many local features, or none, got {len(self.local_features)}"
            )

    def __len__(self) -> int:
        return len(self.features)

    @property
    def has_local_features(self) -> BoolArray:
        """(n,) whether local features of each image were extracted."""
        if not self.local_features:
            return np.zeros(len(self), dtype=np.bool_)
        return np.array([found is not None for found in self.local_features], dtype=np.bool_)

    @property
    def quality(self) -> FloatArray:
        """(n, 3) quality of each image, see :func:`~conformodal.localization.image_quality.image_quality`.

        NaN where local features were not extracted.
        """
        found = self.local_features or [None] * len(self)
        return np.array([NOT_MEASURED if its is None else its.quality for its in found]).reshape(len(self), -1)

    def without_local_features(self) -> FrameEvidence:
        """The same images, as if their local features had not been extracted."""
        return FrameEvidence(self.features)
