"""The interface of pose sources: what estimates where an image was taken.

A pose source is fitted on given frames, estimates the poses of images, and is stored as arrays and JSON. It names the
frames it has seen, since the coverage guarantee needs calibration frames that no source has seen. A new source is a
class with the members of :class:`PoseSource`, registered with :func:`register_source`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib import import_module
from threading import Lock
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

from conformodal.conformal import QuantileBins
from conformodal.core.arrays import AnyArray, Float32Array, FloatArray, IntArray, RealArray
from conformodal.core.parallel import in_threads
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.schema import ArraySchema, ArraySpec, check_arrays, check_json
from conformodal.features.backbone import at_unit_length, coarse_features, feature_views
from conformodal.features.head import Projection, fit_projection
from conformodal.features.local import ORB, Detector, LocalFeatures, Matcher
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import RelativeMotion
from conformodal.io import Recording, SplitKind, held_out_together
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import FrameEvidence, LandmarkView, PoseMeasurement
from conformodal.tracking.motions import frame_features, run_front_end


@dataclass(eq=False)
class SourceData:
    """The training frames, as pose sources see them. A source uses only the frames that it is fitted on."""

    sequence: Recording  # with poses
    features: Float32Array  # (n, F) of all frames
    targets: FloatArray  # (n, 7), see conformodal.localizer.candidates.pose_targets
    sign_reference: FloatArray  # (4,) quaternion that fixes the signs of quaternions
    # how frames are held out, which decides what is left out together to learn the sizes of errors
    split: SplitKind = SplitKind.INTERLEAVED
    depth_m: float = math.nan  # median depth of what the camera sees; NaN where it is not known
    # rows and columns of the network's map, which retrieves places unless local features do; None: thumbnails do
    grid: tuple[int, int] | None = None
    n_bins: int = 50
    margin: float = 0.02  # of the bins
    sigma_bins: float = 0.7  # of order-aware labels
    training: TrainingConfig = field(default_factory=TrainingConfig)  # of networks
    progress: StageProgress | None = None
    detector: Detector = ORB  # of local features
    matcher: Matcher = field(default_factory=Matcher)
    _local_features: dict[int, LocalFeatures] = field(default_factory=dict)
    _extracting: Lock = field(default_factory=Lock)
    _projections: dict[tuple[bytes, int | None], Projection] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """What other processes need; they report no progress."""
        return vars(self) | {"_extracting": None, "progress": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state | {"_extracting": Lock()})

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

    def projection(self, frames: IntArray, components: int | None) -> Projection:
        """Principal components of the network's map of some frames, cached."""
        key = (frames.tobytes(), components)
        if key not in self._projections:
            view = feature_views(self.features.shape[1]).network
            self._projections[key] = fit_projection(self.features[frames], components, view)
        return self._projections[key]

    def run_front_end(self, frames: IntArray, *, local: bool, motions: bool) -> dict[int, RelativeMotion | None]:
        """Motion to each of some frames from the one before, if wanted; `local` caches their local features."""
        missing = [i for i in frames.tolist() if i not in self._local_features] if local else []
        report = stage_of(self.progress, "frames")
        looks = run_front_end(self.sequence, frames, self.detector if missing else None, report, motions=motions)
        self._cache(missing, [looks.features[i] for i in missing])
        return looks.motions

    def local_features(self, frames: IntArray) -> list[LocalFeatures]:
        """Local features of some frames, cached."""
        report = stage_of(self.progress, "local features")
        with self._extracting:  # sources that learn at the same time share them
            missing = [i for i in frames.tolist() if i not in self._local_features]
            extract = partial(frame_features, self.sequence, detector=self.detector)
            self._cache(missing, in_threads(extract, missing, report))
        return [self._local_features[i] for i in frames.tolist()]

    def _cache(self, frames: Sequence[int], features: Sequence[LocalFeatures]) -> None:
        if frames and self.grid is not None and not self.detector.describes_images:
            maps = at_unit_length(coarse_features(self.features[frames], self.grid))
            features = [one._replace(global_descriptor=row) for one, row in zip(features, maps, strict=True)]
        self._local_features.update(zip(frames, features, strict=True))


@dataclass(frozen=True, eq=False)
class SourceAnswer:
    """A source's estimates of n images: probabilities of bins, absolute pose estimates, or both."""

    # seven arrays (n, K_j) over the source's bins, see SourceData.bins_of; None from a source without them
    proba: list[RealArray] | None = None
    measurements: Sequence[Sequence[PoseMeasurement]] = ()  # image by image; of several of one, at most one is right


FRAMES = ArraySpec("lq", ("m",), "increasing", below="n_frames")


@dataclass(frozen=True, eq=False)
class SourceState:
    """A source as it is stored: arrays, and settings that are JSON."""

    arrays: dict[str, AnyArray]
    settings: dict[str, Any] = field(default_factory=dict)
    # of the model for which it is restored: n_frames of its data; n_rows and n_columns of the network's map, n_features
    # and n_coarse features; n_bins of all targets
    sizes: dict[str, int] = field(default_factory=dict)
    bins: Sequence[int] = ()  # of each target of that model

    def check(self, arrays: ArraySchema, settings: dict[str, Any]) -> None:
        """Refuse what does not follow the schemas, see :mod:`conformodal.core.schema`, or does not fit the model."""
        check_json(self.settings, settings, "settings")
        check_arrays(self.arrays, {"frames": FRAMES, **arrays}, dict(self.sizes))
        for name in {"frames", *arrays} - self.arrays.keys():
            raise LocalizationError(f"array {name} is missing")


class PoseSource(Protocol):
    """Estimates the poses of images, after learning from frames with known poses."""

    name: ClassVar[str]  # in saved models and on the command line
    local: ClassVar[bool]  # whether it uses local features; left out where these were not extracted

    @property
    def least_sigma_m(self) -> float:
        """Standard deviation of its best estimates, in metres per axis: what it could add to those of other sources."""
        ...

    @property
    def frames(self) -> IntArray:
        """(m,) frames of the training data that it has seen, increasing."""
        ...

    @classmethod
    def fit(cls, data: SourceData, frames: IntArray) -> Self | None:
        """Learn from `frames` (m,) of the data and from no other; None where it cannot be fitted on them."""
        ...

    def answer(self, evidence: FrameEvidence) -> SourceAnswer:
        """Estimate the poses of n images."""
        ...

    def state(self) -> SourceState:
        """Arrays and settings to store; :meth:`from_state` restores the source from them."""
        ...

    @classmethod
    def from_state(cls, state: SourceState) -> Self:
        """The source that was stored; refuses, by :meth:`SourceState.check`, a state that it could not work with."""
        ...


@runtime_checkable
class TurnsImages(Protocol):
    """A source that knows how an image is turned against the frames that it learnt from."""

    def turn_for(self, position_xyz: FloatArray, quat_wxyz: FloatArray) -> float:
        """Angle in radians by which to turn an image from about a pose, (3,) metres and (4,); 0 to leave it."""
        ...


@runtime_checkable
class CarriesLandmarks(Protocol):
    """A source that estimates poses from corners that were followed from the image before."""

    @property
    def carries(self) -> bool:
        """Whether local features are all that it needs of an image."""
        ...

    def localize(self, image: LocalFeatures) -> list[PoseMeasurement]:
        """Estimates of an image from its local features; their views say which landmarks its corners show."""
        ...

    def carry(
        self, image: LocalFeatures, view: LandmarkView, detected: PoseMeasurement, n_followed: int
    ) -> PoseMeasurement | None:
        """The estimate of an image from followed corners, whose landmarks `view` names beside the last pose.

        `detected` is the last estimate from detected features, of which `n_followed` corners were followed.
        """
        ...


_BUILT_IN = {"head": ".head", "neighbours": ".neighbours", "landmarks": ".landmarks"}
_KINDS: dict[str, type[PoseSource]] = {}


def register_source(kind: type[PoseSource]) -> type[PoseSource]:
    """Register a class of sources by its name, which is of letters, digits, ``_`` and ``-``; usable as a decorator."""
    if not kind.name.replace("-", "_").isidentifier():  # names arrays of a saved model
        raise LocalizationError(f"a pose source's name must be of letters, digits, _ and -, got {kind.name!r}")
    _import_built_in(kind.name)
    if _KINDS.setdefault(kind.name, kind) is not kind:
        raise LocalizationError(f"there is a pose source {kind.name!r} already: {_KINDS[kind.name].__qualname__}")
    return kind


def find_source(name: str) -> type[PoseSource]:
    """The class of sources with a name."""
    _import_built_in(name)
    if name not in _KINDS:
        names = ", ".join(sorted({**_BUILT_IN, **_KINDS}))
        raise LocalizationError(f"pose source must be one of {names}, got {name!r}")
    return _KINDS[name]


def _import_built_in(name: str) -> None:
    """The classes of this package register themselves when they are first asked for."""
    if name in _BUILT_IN:
        import_module(_BUILT_IN[name], __package__)
