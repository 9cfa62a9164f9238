"""The interface of pose sources: what estimates where an image was taken.

A pose source is fitted on given frames, estimates the poses of images, and is stored as arrays and JSON. It names the
frames it has seen, since the coverage guarantee needs calibration frames that no source has seen. A new source is a
class with the members of :class:`PoseSource`, registered with :func:`register_source`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

from conformodal.core.arrays import AnyArray, FloatArray, IntArray, RealArray
from conformodal.core.schema import ArraySchema, ArraySpec, check_arrays, check_json
from conformodal.features.local import LocalFeatures
from conformodal.localizer import LocalizationError
from conformodal.localizer.evidence import FrameEvidence, LandmarkView, PoseMeasurement
from conformodal.localizer.training_data import TrainingData


@dataclass(frozen=True, eq=False)
class SourceAnswer:
    """A source's estimates of n images: probabilities of bins, absolute pose estimates, or both."""

    # seven arrays (n, K_j) over the source's bins, see TrainingData.bins_of; None from a source without them
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
    def fit(cls, data: TrainingData, frames: IntArray) -> Self | None:
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
