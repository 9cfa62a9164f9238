"""Estimates: of one frame of a stream, and of all frames of a sequence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.ranges import as_member
from conformodal.geometry import RelativeMotion, Submap, Trajectory
from conformodal.localizer.candidates import Candidates, mixture_covariance
from conformodal.localizer.filter import Posterior
from conformodal.localizer.measurement import PoseMeasurement
from conformodal.localizer.observations import Observations
from conformodal.localizer.places import Place
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.settings import FILTER
from conformodal.tracking.tracker import Corners

from .errors import OdometryError
from .model import Localization
from .paths import METHODS


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate of one frame of a stream.

    Attributes
    ----------
    timestamp_s
        Seconds.
    pose
        The mean of the most probable place given all frames so far, as a trajectory of one, or None without an image. A
        point estimate: the guarantee is the region's.
    region
        Calibrated region of this frame alone (length 1), or None without an image. Where landmarks were looked for, it
        rests on them too, and is smaller.
    path_region
        Calibrated region from all frames so far (length 1); None without an image, and where the model has none.
    candidates
        Hypotheses of this image alone, or None without an image.
    relative_motion
        Motion since the last usable frame, or None.
    tracks
        Corners of the last answered frame, or of a later one where corners were renewed, and the same ones here, (m, 2)
        pixels each, or None.
    corners
        All corners here, or None without an image.
    estimates
        Absolute pose estimates from landmarks, one per retrieval cluster; empty where there are none.
    known_p
        Conformal p-value of "this image shows a place that is known"; None without an image, and where images are not
        tested. The region is unbounded where it is small.
    evidence
        What the region rests on; None without an image.
    position_spread_m, orientation_spread_rad
        Standard deviations of the most probable place; None without an image. They grow while motion alone tells where
        the camera is.
    posterior
        Hypotheses given all frames so far, and the probability that none is right; or None without an image.
    places
        The places that they make up, most probable first; the first gives the pose. Empty without an image.
    revise
        Called for :attr:`revised`.
    localization
        Belief and region of this frame alone; None without an image.
    reliable
        False where image or motion could not be used, the image shows no place that is known, or other places than the
        chosen one are probable; `problem` says why.
    """

    timestamp_s: float
    pose: Trajectory | None
    region: PoseRegions | None
    candidates: Candidates | None
    relative_motion: RelativeMotion | None
    reliable: bool
    problem: str = ""
    localization: Localization | None = None
    tracks: tuple[FloatArray, FloatArray] | None = None
    corners: Corners | None = None
    estimates: list[PoseMeasurement] = field(default_factory=list)
    known_p: float | None = None
    evidence: EvidenceType | None = None
    position_spread_m: float | None = None
    orientation_spread_rad: float | None = None
    posterior: Posterior | None = None
    places: list[Place] = field(default_factory=list)
    path_region: PoseRegions | None = None
    revise: Callable[[], Trajectory] | None = None

    def __post_init__(self) -> None:
        if self.evidence is not None:
            object.__setattr__(self, "evidence", as_member(self.evidence, EvidenceType, "evidence", OdometryError))

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) of the posterior about :attr:`pose`, all places together; None without an image.

        For the axes see :func:`~conformodal.localizer.candidates.mixture_covariance`; that of the chosen place alone is
        ``places[0].covariance``. Where no hypothesis of the posterior is right, those of the image alone stand.
        """
        if self.pose is None or self.candidates is None:
            return None
        its = self.candidates if self.posterior is None else self.posterior.with_image(self.candidates)
        return mixture_covariance(its, self.pose.positions_xyz[0], self.pose.orientations_quat_wxyz[0])

    @property
    def revised(self) -> Trajectory | None:
        """The last frames in hindsight, oldest first, this one last; None without an image. Worked out when asked for.

        A frame's pose may change until `lag` frames have followed it.
        """
        return self.pose if self.revise is None else self.revise()


@dataclass(eq=False)
class OdometryRun:
    """Estimates of the frames of a sequence, and what they rest on.

    Attributes
    ----------
    frames
        (m,) indices into the sequence that were answered.
    timestamps_s
        (m,) seconds.
    localization
        Belief, region and novelty of each frame alone.
    candidates, motions
        One per frame; ``motions[t]`` leads from the frame before.
    submaps
        Of these frames, by their place in `frames`.
    trajectories
        By method, see :data:`METHODS`.
    answer
        Which of them is the answer.
    unreadable
        Frames that could not be decoded, and why.
    certainty
        (m,) probability of the place that the frames up to each speak for; None where it is not known.
    reliable_p
        A pose counts as reliable from this probability of its place.
    path_regions
        Calibrated regions from posteriors, by :data:`~conformodal.pipeline.model.PATHS`; empty where the model has
        none.
    """

    frames: IntArray
    timestamps_s: FloatArray
    localization: Localization
    candidates: list[Candidates]
    motions: list[RelativeMotion | None]
    submaps: list[Submap]
    trajectories: dict[str, Trajectory]
    unreadable: dict[int, str] = field(default_factory=dict)
    answer: str = METHODS[0]
    certainty: FloatArray | None = None
    reliable_p: float = FILTER.reliable
    path_regions: dict[str, PoseRegions] = field(default_factory=dict)

    @property
    def regions(self) -> PoseRegions:
        """Calibrated regions, one a frame."""
        return self.localization.regions

    @property
    def known_p(self) -> FloatArray:
        """(m,) p-values of showing a known place; NaN where images are not tested."""
        return self.localization.known_p

    @property
    def kinds(self) -> IntArray:
        """(m,) what each region rests on, see :class:`EvidenceType`."""
        return self.localization.kinds

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory of the method :attr:`answer`."""
        return self.trajectories[self.answer]

    @property
    def reliable(self) -> BoolArray:
        """(m,) whether a frame shows a known place, motion could be used, and no other place was probable by then."""
        moving = np.array([m is None or m.reliable for m in self.motions], dtype=np.bool_)
        sure = np.ones(len(moving)) if self.certainty is None else self.certainty
        return np.asarray(moving & (self.kinds != EvidenceType.UNKNOWN) & (sure >= self.reliable_p))

    def observations(self, at: IntArray) -> Observations:
        """The observations of one recording, whose frames are rows `at` (m,) of this run: the input of a reasoner."""
        places = {place: k for k, place in enumerate(at.tolist())}
        submaps = [s for submap in self.submaps if (s := submap.renumbered(places)) is not None]
        motions = [self.motions[t] for t in at]
        known = self.localization.known[at]
        return Observations([self.candidates[t] for t in at], motions, self.timestamps_s[at], submaps, known)
