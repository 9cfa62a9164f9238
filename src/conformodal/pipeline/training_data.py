"""The training data of the pose model and of every baseline."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

from conformodal.core.arrays import Float32Array, FloatArray, IntArray
from conformodal.core.progress import StageProgress
from conformodal.features.backbone import Backbone
from conformodal.features.extract import FeatureCache
from conformodal.features.head import Projection
from conformodal.io import Recording, Split
from conformodal.localizer.sources.registry import SourceData

from .config import ModelConfig
from .depths import measure_depths


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A sequence with its split, the features (n, F) and the targets (n, 7) of all frames."""

    sequence: Recording
    split: Split
    backbone: Backbone
    features: Float32Array
    targets: FloatArray
    sign_reference: FloatArray
    cache: FeatureCache = field(default_factory=lambda: FeatureCache(None))
    _shared: SourceData = field(init=False, repr=False)

    def __post_init__(self) -> None:
        data = SourceData(self.sequence, self.features, self.targets, self.sign_reference, self.split.kind)
        object.__setattr__(self, "_shared", data)

    @cached_property
    def depths(self) -> tuple[float, float]:
        """Median depth in metres and standard deviation of its logarithm, from the training part; or NaN."""
        return measure_depths(self.sequence, self.split.train)

    def for_sources(self, config: ModelConfig, progress: StageProgress | None = None) -> SourceData:
        """The data as pose sources see them; local features and projections are cached for the next call."""
        return replace(
            self._shared,
            depth_m=self.depths[0],
            grid=self.backbone.config.grid,
            n_bins=config.n_bins,
            margin=config.margin,
            sigma_bins=config.sigma_bins,
            training=config.training,
            progress=progress,
        )

    def projection(self, rows: IntArray, components: int | None, *, whole: bool = False) -> Projection:
        """Principal components of some frames, see :meth:`SourceData.projection`."""
        return self._shared.projection(rows, components, whole=whole)
