"""What pose sources see of an image: features of the network and, where they were extracted, local features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray
from conformodal.features.backbone import coarse_features
from conformodal.features.local import LocalFeatures

from .errors import LocalizationError


@dataclass(frozen=True, eq=False)
class FrameEvidence:
    """What pose sources see of n images.

    Attributes
    ----------
    features
        (n, F) of the network, see :class:`~conformodal.features.backbone.Backbone`.
    local_features
        Image by image; empty where they were not extracted.
    """

    features: Float32Array
    local_features: Sequence[LocalFeatures] = ()
    _coarse: dict[tuple[int, int], Float32Array] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if len(self.local_features) not in (0, len(self.features)):
            raise LocalizationError(
                f"{len(self.features)} images need as many local features, or none, got {len(self.local_features)}"
            )

    def __len__(self) -> int:
        return len(self.features)

    def coarse(self, grid: tuple[int, int]) -> Float32Array:
        """(n, G) :func:`~conformodal.features.backbone.coarse_features`, computed once for all that use them."""
        if grid not in self._coarse:
            self._coarse[grid] = coarse_features(self.features, grid)
        return self._coarse[grid]

    @property
    def quality(self) -> FloatArray:
        """(n, 3) :func:`~conformodal.features.local.image_quality` of images with local features."""
        return np.array([features.quality for features in self.local_features])
