"""What pose sources learn from: frames with known poses, and features that several sources share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, partial
from threading import Lock

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import Float32Array, FloatArray, IntArray
from conformodal.core.parallel import in_threads
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.ranges import as_member
from conformodal.features.backbone import feature_views, global_descriptors
from conformodal.features.local import LocalFeatures, Matcher
from conformodal.features.projection import Projection, fit_projection
from conformodal.features.settings import TrainingConfig
from conformodal.io import Recording, SplitKind, held_out_together
from conformodal.localizer.errors import LocalizationError
from conformodal.tracking.flow import frame_features


@dataclass(eq=False)
class SourceData:
    """The training frames, as pose sources see them. A source uses only the frames that it is fitted on.

    Attributes
    ----------
    sequence
        With poses.
    features
        (n, F) of all frames.
    targets
        (n, 7), see :func:`~conformodal.localizer.targets.pose_targets`.
    sign_reference
        (4,) quaternion that fixes the signs of quaternions.
    split
        How frames are held out, which decides what is left out together to learn the sizes of errors.
    depth_m
        Median depth of what the camera sees; NaN where it is not known.
    grid
        Rows and columns of the network's map, which retrieves places; None retrieves them by thumbnails.
    n_bins, margin, sigma_bins
        Of the bins, and of the order-aware labels.
    training
        Of networks.
    progress
        Called with the stage, steps done and steps in all.
    """

    sequence: Recording
    features: Float32Array
    targets: FloatArray
    sign_reference: FloatArray
    split: SplitKind = SplitKind.INTERLEAVED
    depth_m: float = math.nan
    grid: tuple[int, int] | None = None
    n_bins: int = 50
    margin: float = 0.02
    sigma_bins: float = 0.7
    training: TrainingConfig = field(default_factory=TrainingConfig)
    progress: StageProgress | None = None
    matcher: Matcher = field(default_factory=Matcher)
    _local_features: dict[int, LocalFeatures] = field(default_factory=dict)
    _extracting: Lock = field(default_factory=Lock)
    _projections: dict[tuple[bytes, int | None, bool], Projection] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.split = as_member(self.split, SplitKind, "split", LocalizationError)

    def bins_of(self, frames: IntArray) -> QuantileBins:
        """Bins of the targets of some frames."""
        return QuantileBins(self.n_bins, self.margin).fit(self.targets[frames])

    @cached_property
    def pieces(self) -> IntArray:
        """(n,) labels: frames with the same label are left out together, as the split holds them out."""
        return held_out_together(self.sequence.recording, self.split, given_test=self.sequence.given_test)

    @cached_property
    def stretches(self) -> IntArray:
        """(n,) labels of contiguous stretches."""
        return held_out_together(self.sequence.recording, SplitKind.BLOCKS)

    def projection(self, frames: IntArray, components: int | None, *, whole: bool = False) -> Projection:
        """Principal components of some frames' features, cached; `whole` adds the global descriptor to the map."""
        key = (frames.tobytes(), components, whole)
        if key not in self._projections:
            views = feature_views(self.features.shape[1])
            view = views.both if whole else views.network
            self._projections[key] = fit_projection(self.features[frames], components, view)
        return self._projections[key]

    def local_features(self, frames: IntArray) -> list[LocalFeatures]:
        """Local features of some frames, cached."""
        report = stage_of(self.progress, "local features")
        with self._extracting:  # sources that learn at the same time share them
            missing = [i for i in frames.tolist() if i not in self._local_features]
            found = in_threads(partial(frame_features, self.sequence), missing, report)
            if missing and self.grid is not None:
                maps = global_descriptors(self.features[missing], self.grid)
                found = [its._replace(global_descriptor=row) for its, row in zip(found, maps, strict=True)]
            self._local_features.update(zip(missing, found, strict=True))
        return [self._local_features[i] for i in frames.tolist()]
