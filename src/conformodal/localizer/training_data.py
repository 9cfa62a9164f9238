"""What pose sources learn from: frames with poses, their features, and the split that says which may be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any, Self

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import Float32Array, FloatArray, IntArray
from conformodal.core.parallel import in_threads
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.backbone import Backbone, at_unit_length, coarse_features, feature_views
from conformodal.features.extract import FeatureCache
from conformodal.features.head import Projection, fit_projection
from conformodal.features.local import ORB, Detector, LocalFeatures, Matcher
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import RelativeMotion
from conformodal.io import Recording, Split, SplitKind, held_out_together
from conformodal.localizer import LocalizationError
from conformodal.tracking.depths import UNKNOWN_DEPTH, SceneDepth
from conformodal.tracking.motions import frame_features, run_front_end

from .landmark_settings import LandmarkSettings


@dataclass(frozen=True)
class SourceSettings:
    """Settings of pose sources."""

    n_bins: int = 50  # per target
    margin: float = 0.02  # share of the range by which bins reach beyond the training poses
    sigma_bins: float = 0.7  # width of order-aware labels, in bins
    training: TrainingConfig = field(default_factory=TrainingConfig)  # of networks
    landmarks: LandmarkSettings = field(default_factory=LandmarkSettings)


class ComputedOnce:
    """Local features of frames, their matches, and projections of features: sources and folds share them."""

    def __init__(self) -> None:
        self.local_features: dict[int, LocalFeatures] = {}
        self.projections: dict[tuple[bytes, int | None], Projection] = {}
        self.matcher = Matcher()
        self.extracting = Lock()

    def __getstate__(self) -> dict[str, Any]:
        """What other processes need."""
        return vars(self) | {"extracting": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state | {"extracting": Lock()})


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Recordings with poses, split, with the features and targets of all frames.

    A pose source uses only the frames that it is fitted on.
    """

    sequence: Recording  # with poses
    split: Split
    features: Float32Array  # (n, F) of all frames
    targets: FloatArray  # (n, 7), see conformodal.geometry.pose_targets
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions
    backbone: Backbone | None = None  # that the features are of; None where they come from elsewhere
    cache: FeatureCache = field(default_factory=lambda: FeatureCache(None))  # of features
    detector: Detector = ORB  # of local features
    depth: SceneDepth = UNKNOWN_DEPTH  # in the training part
    settings: SourceSettings = field(default_factory=SourceSettings)
    progress: StageProgress | None = None
    # rows and columns of the network's map, which retrieves places unless local features do; None: thumbnails do
    grid: tuple[int, int] | None = None
    # of this object alone: other features or frames have their own
    computed: ComputedOnce = field(default_factory=ComputedOnce, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """What other processes need: the network of the features stays here, and no progress is reported there."""
        return vars(self) | {"backbone": None, "progress": None}

    def with_features_of(self, frames: IntArray) -> Self:
        """The same data with nothing computed but the local features of some frames: little to send to a worker."""
        part = replace(self)
        part.computed.local_features.update(zip(frames.tolist(), self.local_features(frames), strict=True))
        return part

    def require_backbone(self) -> Backbone:
        """The network of the features; refused where they come from elsewhere."""
        if self.backbone is None:
            raise LocalizationError("the training data has features without the network that computes them")
        return self.backbone

    def bins_of(self, frames: IntArray) -> QuantileBins:
        """Bins of the targets of some frames."""
        return QuantileBins(self.settings.n_bins, self.settings.margin).fit(self.targets[frames])

    @cached_property
    def pieces(self) -> IntArray:
        """(n,) labels: frames with the same label are left out together, as the split holds them out."""
        return held_out_together(self.sequence.recording, self.split.kind, given_test=self.sequence.given_test)

    @cached_property
    def stretches(self) -> IntArray:
        """(n,) labels of contiguous stretches."""
        return held_out_together(self.sequence.recording, SplitKind.BLOCKS)

    def projection(self, frames: IntArray, components: int | None) -> Projection:
        """Principal components of the network's map of some frames, cached."""
        projections, key = self.computed.projections, (frames.tobytes(), components)
        if key not in projections:
            view = feature_views(self.features.shape[1]).network
            projections[key] = fit_projection(self.features[frames], components, view)
        return projections[key]

    def run_front_end(self, frames: IntArray, *, local: bool, motions: bool) -> dict[int, RelativeMotion | None]:
        """Motion to each of some frames from the one before, if wanted; `local` caches their local features."""
        missing = [i for i in frames.tolist() if i not in self.computed.local_features] if local else []
        report = stage_of(self.progress, "frames")
        looks = run_front_end(self.sequence, frames, self.detector if missing else None, report, motions=motions)
        self._keep(missing, [looks.features[i] for i in missing])
        return looks.motions

    def local_features(self, frames: IntArray) -> list[LocalFeatures]:
        """Local features of some frames, cached."""
        report, known = stage_of(self.progress, "local features"), self.computed.local_features
        with self.computed.extracting:  # sources that learn at the same time share them
            missing = [i for i in frames.tolist() if i not in known]
            extract = partial(frame_features, self.sequence, detector=self.detector)
            self._keep(missing, in_threads(extract, missing, report))
        return [known[i] for i in frames.tolist()]

    def _keep(self, frames: Sequence[int], features: Sequence[LocalFeatures]) -> None:
        if frames and self.grid is not None and not self.detector.describes_images:
            maps = at_unit_length(coarse_features(self.features[frames], self.grid))
            features = [one._replace(global_descriptor=row) for one, row in zip(features, maps, strict=True)]
        self.computed.local_features.update(zip(frames, features, strict=True))
