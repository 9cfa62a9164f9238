"""What the pose model and every baseline learn from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from conformodal.datasets import Sequence, Split
from conformodal.vision import Backbone, Projection, feature_views, fit_projection


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A sequence's features, targets and parts: what the pose model and every baseline share.

    Attributes
    ----------
    features
        (n, F) of all frames.
    targets
        (n, 7), see :func:`~conformodal.odometry.targets.pose_targets`.
    """

    sequence: Sequence
    split: Split
    backbone: Backbone
    features: npt.NDArray[np.float32]
    targets: npt.NDArray[np.float64]
    sign_reference: npt.NDArray[np.float64]
    _projections: dict[tuple[bytes, int | None, bool], Projection] = field(default_factory=dict, init=False, repr=False)

    def projection(self, rows: npt.NDArray[np.int64], components: int | None, *, thumbnail: bool = False) -> Projection:
        """Of some frames' features, fitted once; with or without their thumbnails.

        Parameters
        ----------
        rows
            Frames that it may know.
        components, thumbnail
            See :func:`~conformodal.vision.fit_projection`, and :func:`~conformodal.vision.feature_views`.
        """
        key = (rows.tobytes(), components, thumbnail)
        if key not in self._projections:
            views = feature_views(self.features.shape[1])
            view = views.both if thumbnail else views.network
            self._projections[key] = fit_projection(self.features[rows], components, view)
        return self._projections[key]
