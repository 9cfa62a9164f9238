"""The interface of pose sources: what estimates where an image was taken.

A pose source is fitted on given frames, estimates the poses of images, and is stored as arrays and JSON. It names the
frames it has seen, since the coverage guarantee needs calibration frames that no source has seen. A new source is a
class with the four methods of :class:`PoseSource`, registered with :func:`register_source`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar, Protocol, Self

from conformodal.core.arrays import AnyArray, IntArray, RealArray
from conformodal.localizer.errors import LocalizationError
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.measurement import PoseMeasurement

from .source_data import SourceData


@dataclass(frozen=True, eq=False)
class SourceAnswer:
    """A source's estimates of n images: probabilities of bins, absolute pose estimates, or both.

    Attributes
    ----------
    proba
        Seven arrays (n, K_j) over the source's bins, see :attr:`SourceData.bins_of`; None from a source without them.
    measurements
        Image by image; of several of one image, at most one is right.
    """

    proba: list[RealArray] | None = None
    measurements: Sequence[Sequence[PoseMeasurement]] = ()


@dataclass(frozen=True, eq=False)
class SourceState:
    """A source as it is stored: arrays, and settings that are JSON."""

    arrays: dict[str, AnyArray]
    settings: dict[str, Any] = field(default_factory=dict)


class PoseSource(Protocol):
    """Estimates the poses of images, after learning from frames with known poses.

    Attributes
    ----------
    name
        In saved models and on the command line.
    local
        Whether it uses local features; its answers are left out where these were not extracted.
    frames
        (m,) frames of the training data that it has seen, increasing.
    """

    name: ClassVar[str]
    local: ClassVar[bool]

    @property
    def frames(self) -> IntArray:
        """Frames that it has seen."""
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
        """The source that was stored."""
        ...


_BUILT_IN = {"head": ".head", "landmarks": ".landmarks"}
_KINDS: dict[str, type[PoseSource]] = {}


def register_source(kind: type[PoseSource]) -> type[PoseSource]:
    """Register a class of sources by its name; also usable as a decorator.

    Raises
    ------
    LocalizationError
        If another class has that name, or the name is not one of letters, digits, ``_`` and ``-``.
    """
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
        raise LocalizationError(
            f"pose source must be one of {', '.join(sorted({**_BUILT_IN, **_KINDS}))}, got {name!r}"
        )
    return _KINDS[name]


def _import_built_in(name: str) -> None:
    """The classes of this package register themselves when they are first asked for."""
    if name in _BUILT_IN:
        import_module(_BUILT_IN[name], __package__)
