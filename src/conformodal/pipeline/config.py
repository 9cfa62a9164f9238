"""Settings of a pose model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal, Self

from conformodal.conformal import ConformodalError, QuantileBins
from conformodal.conformal.checks import as_alpha, as_choice
from conformodal.conformal.scores import resolve_score
from conformodal.core.ranges import as_member, check_ranges, check_shares
from conformodal.features.local import DETECTORS
from conformodal.features.settings import TrainingConfig, check_network
from conformodal.io import SplitKind
from conformodal.localizer.sources.registry import find_source
from conformodal.localizer.training_data import SourceSettings


class OdometryError(ConformodalError):
    """Frames, parts or settings that a model cannot work with."""


class Calibration(StrEnum):
    """What the thresholds of regions are calibrated on.

    ``frames``: the calibration part; the guarantee is about a frame exchangeable with its frames. ``stretches``:
    training and calibration part together, cut into stretches, or recordings where there are enough for alpha; each is
    answered by sources that have not seen it, and the guarantee is about a random frame of a new stretch. ``auto``:
    frames where the split holds out single frames, else stretches.
    """

    AUTO = "auto"
    FRAMES = "frames"
    STRETCHES = "stretches"


class Method(StrEnum):
    """Whose system a model is: this project's or the paper's."""

    CONFORMODAL = "conformodal"
    PAPER = "paper"


@dataclass(frozen=True)
class ModelConfig:
    """Settings of a pose model; one that cannot be used is refused before any frame is read."""

    method: Method = Method.CONFORMODAL  # this project's system, or the paper's: see :meth:`paper`
    split: SplitKind = SplitKind.BLOCKS
    n_bins: int = 50  # per target (K)
    margin: float = 0.02  # share of the range by which bins reach beyond the training poses
    sigma_bins: float = 0.7  # width of the order-aware labels, in bins; 0 for the paper's one-hot labels
    alpha: float = 0.1  # as the next two, of :class:`~conformodal.conformal.SplitConformal`
    score: str = "hpd"
    joint: Literal["none", "max"] = "max"
    test: float = 0.2  # as the next two, shares of all frames or recordings, see :func:`~conformodal.io.make_split`
    calibration: float = 0.16
    used: float | None = None
    calibrate_on: Calibration = Calibration.AUTO
    # images whose p-value of showing a known place is at most this get an unbounded region; None for 0.015 where single
    # frames are held out, and 0.1 where stretches are
    novelty_level: float | None = None
    # in the order in which they are fused, see :class:`~conformodal.localizer.sources.registry.PoseSource`
    sources: tuple[str, ...] = ("head", "neighbours", "landmarks")
    features: str = "orb"  # local ones, of :data:`~conformodal.features.local.DETECTORS`
    network: str = "efficientnet_lite0"  # of :data:`~conformodal.features.settings.NETWORKS`, or ``hf:NAME``
    seed: int = 0  # of the split and of training
    training: TrainingConfig = field(default_factory=TrainingConfig)  # of the head

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            object.__setattr__(self, name, as_member(getattr(self, name), choices, name, OdometryError))
        check_ranges(vars(self), OdometryError)
        check_shares(self.test, self.calibration, self.used, OdometryError)
        object.__setattr__(self, "alpha", float(as_alpha(self.alpha)))
        as_choice(self.joint, Literal["none", "max"], "joint")
        resolve_score(self.score)
        QuantileBins(self.n_bins, self.margin).check_parameters()
        check_network(self.network)
        if self.features not in DETECTORS:
            raise OdometryError(f"features must be one of {', '.join(DETECTORS)}, got {self.features!r}")
        if not self.sources or len(set(self.sources)) < len(self.sources):
            raise OdometryError(f"sources must be different names, at least one, got {self.sources}")
        for name in self.sources:
            find_source(name)
        if self.features != "orb" and not any(find_source(name).local for name in self.sources):
            raise OdometryError(f"features {self.features!r} describe landmarks, and no pose source uses them")
        if self.method is Method.PAPER:
            wrong = {k: getattr(self, k) for k, v in _PAPER.items() if getattr(self, k) != v}
            if wrong or self.training.components is not None:
                raise OdometryError(f"the paper's system has no settings {wrong or 'training.components'}")

    @classmethod
    def paper(cls, **settings: Any) -> Self:
        """The paper's system (Parente et al. 2024, sections 2 and 3); `settings` are the other attributes.

        Features of the whole network, averaged over the image; one softmax per dimension, with one-hot labels; quantile
        bins without margin; the score ``lac``; each dimension calibrated at alpha by itself, on random frames of the
        training data, whatever the split; no other pose source, search or smoother. What the paper does not specify is
        as in this project: image size, a frozen network, optimiser, epochs, and a hidden layer before the softmaxes.
        """
        training = replace(settings.pop("training", TrainingConfig()), components=None)
        defaults = {**_PAPER, "split": SplitKind.INTERLEAVED, "training": training}
        return cls(**{**defaults, **settings, "method": Method.PAPER})

    @property
    def for_sources(self) -> SourceSettings:
        """Those of pose sources."""
        return SourceSettings(self.n_bins, self.margin, self.sigma_bins, self.training)


_CHOICES: dict[str, type[StrEnum]] = {"method": Method, "split": SplitKind, "calibrate_on": Calibration}
# Settings that define the paper's system.
_PAPER: dict[str, Any] = {
    "margin": 0.0,
    "sigma_bins": 0.0,
    "score": "lac",
    "joint": "none",
    "calibrate_on": Calibration.FRAMES,
    "novelty_level": 0.0,
    "sources": ("head",),
    "features": "orb",  # the head looks at none
}
