"""A trained and calibrated pose model: from the evidence of an image to its belief and its region."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.conformal.checks import Alpha
from conformodal.core.choices import as_member
from conformodal.core.ranges import check_ranges
from conformodal.datasets import Split
from conformodal.localization.belief import Beliefs
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.landmarks.source import LandmarkSource
from conformodal.localization.localizer import Localizer
from conformodal.poses import PinholeCamera
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.prior import MotionPrior
from conformodal.vision.backbone import Backbone

from .comparison import SourceComparison
from .config import Method
from .errors import OdometryError
from .identity import FrameIdentities
from .place_novelty import PlaceNovelty
from .radius import PoseRadius
from .region_rules import EvidenceType, RegionRules


@dataclass(frozen=True, eq=False)
class Localization:
    """Beliefs and regions of n images, each by itself.

    Attributes
    ----------
    beliefs
        From which regions are calibrated, and paths chosen.
    regions
        Calibrated.
    known_p
        (n,) p-values of "this image shows a place that is known"; NaN where images are not tested.
    kinds
        (n,) what each region rests on, see :class:`~conformodal.model.region_rules.EvidenceType`.
    """

    beliefs: Beliefs
    regions: Regions
    known_p: npt.NDArray[np.float64]
    kinds: npt.NDArray[np.int64]

    @property
    def candidates(self) -> list[Candidates]:
        """The hypotheses of each belief."""
        return [mixture.candidates for mixture in self.beliefs.mixtures]

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) whether each image shows a place that is known."""
        return np.asarray(self.kinds != EvidenceType.UNKNOWN)


@dataclass(eq=False)
class PoseModel:
    """What training and calibration leave behind.

    Attributes
    ----------
    backbone
        Image to features.
    localizer
        Evidence to belief, by pose sources that have not seen the calibration frames (or, where stretches calibrate,
        by sources like those that had not).
    novelty
        Test of images against the frames that the sources know; None where nothing tells them.
    rules
        Belief to region: calibrated thresholds, by kind of evidence.
    prior
        What reasoning needs to know of motion.
    camera
        Camera of the training images.
    split
        Which frames were used for what.
    known_frames
        All frames of the training data, in the order that `split` numbers them in, to know them again.
    configuration
        Settings behind the model but alpha and the novelty level, which can change, see :attr:`settings`.
    radius
        Guarantee for the chosen pose, see :class:`~conformodal.model.radius.PoseRadius`; None before it was calibrated.
    comparison
        Where stretches calibrate, whether held-out scores are those of the sources that calibrated.
    """

    backbone: Backbone
    localizer: Localizer
    novelty: PlaceNovelty | None
    rules: RegionRules
    prior: MotionPrior
    camera: PinholeCamera
    split: Split
    known_frames: FrameIdentities
    configuration: dict[str, Any] = field(default_factory=dict)
    radius: PoseRadius | None = None
    comparison: SourceComparison | None = None

    @property
    def method(self) -> Method:
        """The system that the model belongs to."""
        return as_member(self.configuration.get("method", Method.CONFORMODAL), Method, "method", OdometryError)

    @property
    def alpha(self) -> float:
        """Miscoverage rate of the regions."""
        return float(self.rules.overall.alpha)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings in force, as records of results state them."""
        return {**self.configuration, "alpha": self.alpha, "novelty_level": float(self.rules.level)}

    @property
    def bins(self) -> QuantileBins:
        """Bins of the seven targets."""
        return self.localizer.bins

    @property
    def sign_reference(self) -> npt.NDArray[np.float64]:
        """(4,) quaternion that fixes the signs of quaternions."""
        return self.localizer.sign_reference

    @property
    def calibration(self) -> SplitConformal:
        """Calibrated sets from beliefs without local features, whatever the image."""
        return self.rules.overall

    @property
    def n_calibration(self) -> int:
        """Calibration frames behind the thresholds."""
        return int(self.calibration.scores_.shape[0])

    @property
    def looks_at_local_features(self) -> bool:
        """Whether local features of an image change its estimate."""
        return self.localizer.local and self.rules.matched is not None

    @property
    def landmarks(self) -> LandmarkSource | None:
        """The source that does PnP on landmarks, if there is one."""
        return self.localizer.find(LandmarkSource)

    def localize(self, evidence: FrameEvidence) -> Localization:
        """Beliefs and calibrated regions of n images: the one way from an image to its region."""
        if not self.looks_at_local_features:  # then nothing calibrates what they add
            evidence = evidence.without_local_features()
        beliefs = self.localizer.beliefs(evidence)
        novelty = self.novelty
        p = np.full(len(evidence), np.nan) if novelty is None else novelty.p_values(evidence.features)
        kinds = self.rules.kinds(p, evidence.has_local_features, beliefs.recognised)
        return Localization(beliefs, self.regions(beliefs, self.rules.thresholds(kinds)), p, kinds)

    def regions(self, beliefs: Beliefs, thresholds: npt.NDArray[np.floating[Any]]) -> Regions:
        """Level sets of n beliefs at thresholds (n, 7) of the score. All of one model's have the same bins."""
        parts = self.localizer.marginals_by_part(beliefs)
        return Regions.concatenate([self.rules.overall.regions_at(p, thresholds[rows]) for rows, p in parts])

    def calibration_of(self, *, local: bool) -> SplitConformal:
        """The rule that is calibrated on all frames: on beliefs with local features, or without."""
        return self.rules.matched if local and self.rules.matched is not None else self.rules.overall

    def recalibrate(self, alpha: Alpha) -> None:
        """Guarantee another miscoverage rate, from the stored calibration scores.

        Raises
        ------
        ConformalError
            If `alpha` is outside (0, 1).
        """
        self.rules = self.rules.at(alpha)

    def set_novelty_level(self, level: float) -> None:
        """Take images for unknown whose p-value is at most `level`; at 0 no image is.

        Raises
        ------
        OdometryError
            If `level` is negative, or 1 or more.
        """
        check_ranges({"novelty_level": level}, OdometryError)
        self.rules = replace(self.rules, level=0.0 if self.novelty is None else self.novelty.level(level))

    def check_camera(self, camera: PinholeCamera, tolerance: float = 1e-3) -> None:
        """Refuse images of another camera: poses were learnt through this one.

        Parameters
        ----------
        camera
            Of the images.
        tolerance
            How far intrinsics may differ, as a share of the image's width.

        Raises
        ------
        OdometryError
            If size, intrinsics or distortion differ.
        """
        mine, other = self.camera, camera
        same = (mine.width, mine.height) == (other.width, other.height)
        values = [(mine.fx, other.fx), (mine.fy, other.fy), (mine.cx, other.cx), (mine.cy, other.cy)]
        same = same and _lens(mine) == _lens(other)
        if not same or any(abs(a - b) > tolerance * mine.width for a, b in values):
            raise OdometryError(f"the model was trained with {mine}, the source has {other}")


def _lens(camera: PinholeCamera) -> tuple[float, ...]:
    """All five distortion coefficients; a file may leave out those that are zero."""
    return (*camera.distortion, *[0.0] * (5 - len(camera.distortion)))
