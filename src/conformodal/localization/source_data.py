"""What pose sources learn from: frames with known poses, and computations that all sources share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import IntArray
from conformodal.core.choices import as_member
from conformodal.core.progress import StageProgress, stage_of
from conformodal.datasets import Sequence, SplitKind, held_out_together
from conformodal.vision.backbone import feature_views
from conformodal.vision.projection import Projection, fit_projection
from conformodal.vision.settings import TrainingConfig

from .errors import LocalizationError
from .local_features import LocalFeatures, Matcher, extract_local_features


@dataclass(eq=False)
class SourceData:
    """Frames of a sequence, as pose sources see them. A source looks at the frames that it is fitted on alone.

    Attributes
    ----------
    sequence
        With poses.
    features
        (n, F) of all frames.
    targets
        (n, 7), see :func:`~conformodal.localization.targets.pose_targets`.
    sign_reference
        (4,) quaternion that fixes the signs of quaternions.
    split
        How frames are held out: what is left out together to learn how large errors are.
    depth_m
        Median depth of what the camera sees; NaN where it is not known.
    n_bins, margin, sigma_bins
        Of the bins, and of the order-aware labels.
    training
        Of networks.
    checkpoint_dir
        Where networks keep their state while they are trained; None keeps nothing.
    progress
        Called with the stage, what is done and what is to be done.
    """

    sequence: Sequence
    features: npt.NDArray[np.float32]
    targets: npt.NDArray[np.float64]
    sign_reference: npt.NDArray[np.float64]
    split: SplitKind = SplitKind.INTERLEAVED
    depth_m: float = math.nan
    n_bins: int = 50
    margin: float = 0.02
    sigma_bins: float = 0.7
    training: TrainingConfig = field(default_factory=TrainingConfig)
    checkpoint_dir: Path | None = None
    progress: StageProgress | None = None
    matcher: Matcher = field(default_factory=Matcher)
    _local_features: dict[int, LocalFeatures] = field(default_factory=dict)
    _projections: dict[tuple[bytes, int | None, bool], Projection] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.split = as_member(self.split, SplitKind, "split", LocalizationError)

    def bins_of(self, frames: IntArray) -> QuantileBins:
        """Bins of the targets of some frames."""
        return QuantileBins(self.n_bins, self.margin).fit(self.targets[frames])

    @cached_property
    def pieces(self) -> IntArray:
        """(n,) labels: frames of one piece are left out together, as the split holds them out."""
        return held_out_together(self.sequence.recording, self.split, given_test=self.sequence.given_test)

    @cached_property
    def stretches(self) -> IntArray:
        """(n,) labels of contiguous stretches."""
        return held_out_together(self.sequence.recording, SplitKind.BLOCKS)

    def projection(self, frames: IntArray, components: int | None, *, whole: bool = False) -> Projection:
        """Principal components of some frames' features, fitted once.

        Parameters
        ----------
        frames
            Frames that it may know.
        components
            See :func:`~conformodal.vision.projection.fit_projection`.
        whole
            Whether the global descriptor that features end in counts too, beside the network's map.
        """
        key = (frames.tobytes(), components, whole)
        if key not in self._projections:
            views = feature_views(self.features.shape[1])
            view = views.both if whole else views.network
            self._projections[key] = fit_projection(self.features[frames], components, view)
        return self._projections[key]

    def local_features(self, frames: IntArray) -> list[LocalFeatures]:
        """Local features of some frames, extracted once.

        Raises
        ------
        ImageError
            If an image cannot be read; names the file.
        """
        report = stage_of(self.progress, "local features")
        missing = [i for i in frames.tolist() if i not in self._local_features]
        for done, i in enumerate(missing, start=1):
            self._local_features[i] = extract_local_features(self.sequence.image(i), self.sequence.camera)
            if report is not None:
                report(done, len(missing))
        return [self._local_features[i] for i in frames.tolist()]
