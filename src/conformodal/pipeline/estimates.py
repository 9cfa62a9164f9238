"""Estimates: of one frame of a stream, and of all frames of a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.geometry import Pose, RelativeMotion, Trajectory
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import Observations, Place, Posterior
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import TrackedCorners

from .model import Localization, PoseModel


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate of one frame of a stream; what rests on an image is None where the frame has none."""

    timestamp_s: float
    # the mean of the most probable place given all frames so far. A point estimate: the guarantee is the region's
    pose: Pose | None = None
    # calibrated region of this frame alone (length 1); where landmarks were looked for, it rests on them too
    region: PoseRegions | None = None
    candidates: PoseMixture | None = None  # hypotheses of this image alone
    relative_motion: RelativeMotion | None = None  # since the last usable frame
    # whether image and motion could be used, the image shows a known place, and no other place is probable; and why not
    reliable: bool = False
    problem: str = ""
    localization: Localization | None = None  # belief and region of this frame alone
    # corners of the last answered frame, or of a later one where corners were renewed, and the same ones here, (m, 2)
    # pixels each
    tracks: tuple[FloatArray, FloatArray] | None = None
    corners: TrackedCorners | None = None  # all corners here
    estimates: list[PoseMeasurement] = field(default_factory=list)  # from landmarks, one per retrieval cluster
    carried: bool = False  # whether landmarks were followed from the frame before, not detected
    # conformal p-value of "this image shows a place that is known"; None where images are not tested
    known_p: float | None = None
    evidence: EvidenceType | None = None  # what the region rests on
    # standard deviations of the most probable place as believed, see `covariance` for calibrated ones; they grow while
    # motion alone tells where the camera is
    position_spread_m: float | None = None
    orientation_spread_rad: float | None = None
    variance_factor: float = 1.0  # of the posterior's covariance, calibrated on held-out streams
    posterior: Posterior | None = None  # hypotheses given all frames so far
    places: list[Place] = field(default_factory=list)  # that they make up, most probable first; the first is the pose
    path_region: PoseRegions | None = None  # calibrated region from all frames so far (length 1)
    revise: Callable[[], Trajectory] | None = None  # called for `revised`

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) of the posterior about :attr:`pose`, all places together; None without an image.

        It is calibrated by :meth:`.model.PathRule.variance_factors`, of frames whose region from all frames so far is
        bounded. For the axes see :meth:`~conformodal.localizer.mixtures.PoseMixture.covariance`. Where no hypothesis of
        the posterior is right, those of the image alone stand.
        """
        if self.pose is None or self.candidates is None:
            return None
        mixture = self.candidates if self.posterior is None else self.posterior.with_image(self.candidates)
        moments = mixture.covariance(self.pose.position_xyz, self.pose.orientation_quat_wxyz)
        return self.variance_factor * moments

    @property
    def revised(self) -> Trajectory | None:
        """The last frames in hindsight, oldest first, this one last; None without an image. Worked out when asked for.

        A frame's pose may change until ten frames have followed it.
        """
        if self.pose is None:
            return None
        return self.pose.at(self.timestamp_s) if self.revise is None else self.revise()


@dataclass(eq=False)
class OdometryRun:
    """Estimates of the frames of a recording, as the stream gave them."""

    model: PoseModel
    frames: IntArray  # (m,) indices of the answered frames
    recording: IntArray  # (m,) number of the recording of each
    estimates: list[Estimate]  # with an image each
    trajectories: dict[str, Trajectory]  # by method, see :data:`~conformodal.pipeline.model.METHODS`
    answer: str  # which of them is the answer
    unreadable: dict[int, str] = field(default_factory=dict)  # frames without an image that can be used, and why
    # from posteriors, by :data:`~conformodal.pipeline.model.PATHS`; empty where the model has none
    path_regions: dict[str, PoseRegions] = field(default_factory=dict)

    @cached_property
    def localization(self) -> Localization:
        """Belief, region and novelty of each frame alone."""
        return Localization.concatenate([e.localization for e in self.estimates if e.localization is not None])

    @property
    def timestamps_s(self) -> FloatArray:
        """(m,) seconds."""
        return np.array([estimate.timestamp_s for estimate in self.estimates])

    @property
    def regions(self) -> PoseRegions:
        """Calibrated regions, one per frame."""
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
    def reliable(self) -> BoolArray:
        """(m,) whether a frame shows a known place, motion could be used, and no other place was probable by then."""
        return np.array([estimate.reliable for estimate in self.estimates], dtype=np.bool_)

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory of the method :attr:`answer`."""
        return self.trajectories[self.answer]

    def observations(self, rows: IntArray) -> Observations:
        """The observations of one recording, whose frames are `rows` (m,) of this run: the input of a reasoner."""
        return observations_of([self.estimates[i] for i in rows.tolist()], self.model)


def observations_of(estimates: list[Estimate], model: PoseModel) -> Observations:
    """What is known of consecutive frames of one recording, submaps included."""
    corners = [e.corners for e in estimates if e.corners is not None]
    return Observations(
        [e.candidates for e in estimates if e.candidates is not None],
        [e.relative_motion for e in estimates],
        np.array([e.timestamp_s for e in estimates]),
        build_submaps(corners, model.camera),
        np.array([e.localization.known[0] for e in estimates if e.localization is not None]),
    )
