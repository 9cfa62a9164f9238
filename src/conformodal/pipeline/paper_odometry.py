"""The paper's system, as it stands: a network with softmaxes, their calibration, and greedy reasoning."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import Float32Array, IntArray, UInt8Array, rows_by_label
from conformodal.core.progress import StageProgress
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.localizer.candidates import interval_candidates, interval_runs
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.greedy import Greedy, greedy
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import Support, pose_regions
from conformodal.tracking.frontend import EssentialFrontEnd
from conformodal.tracking.motions import MotionRecord, measure_motions

from .config import Method
from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .estimator import VisualOdometry
from .model import Localization, PoseModel
from .odometry import Odometry
from .paths import PAPERS_METHOD, as_trajectory


class PaperOdometry(Odometry):
    """The paper's system on a stream or a sequence; its estimates have the form of those of :class:`VisualOdometry`.

    Parameters
    ----------
    model
        Trained with :meth:`ModelConfig.paper`.

    Raises
    ------
    OdometryError
        If the model is another.
    """

    answer = PAPERS_METHOD
    lag = 0
    whole_paths = False  # what a stream is told is final

    def __init__(self, model: PoseModel) -> None:
        if model.method is not Method.PAPER:
            raise OdometryError("the model was not trained with the paper's method; VisualOdometry runs it")
        self.model = model
        self.reset()

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = EssentialFrontEnd(self.model.camera)
        self._path = Greedy()
        self._seen_s = self._shown_s = None

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        found = _localize(self.model, self.model.backbone.features_of(image))
        proba, region = found.beliefs.proba, found.regions
        motion = self._front_end.measure(image)
        path = self._path.push(interval_runs(proba, region)[0], motion, timestamp_s)
        pose = as_trajectory(path)
        reliable = motion is None or motion.reliable
        return Estimate(
            timestamp_s,
            pose,
            region,
            interval_candidates(proba, region)[0],
            motion,
            reliable,
            "" if reliable or motion is None else str(motion.status),
            found,
            self._front_end.tracks,
            self._front_end.corners,
            evidence=EvidenceType.GLOBAL,
            position_spread_m=float(np.linalg.norm(path.position_spreads[0])),
            orientation_spread_rad=float(path.orientation_spreads_rad[0]),
        )

    def measure_motions(
        self, sequence: Recording, frames: IntArray, progress: StageProgress | None = None
    ) -> MotionRecord:
        """Relative motions of `frames` as the paper has them."""
        return measure_motions(sequence, frames, progress, front_end=EssentialFrontEnd(sequence.camera), local=False)

    def _answered(
        self, sequence: Recording, frames: IntArray, features: Float32Array, motions: MotionRecord
    ) -> OdometryRun:
        localization = _localize(self.model, features)
        proba, regions = localization.beliefs.proba, localization.regions
        times, recording = sequence.timestamps_s[frames], sequence.recording[frames]
        intervals, moved = interval_runs(proba, regions), [motions.motions[i] for i in frames.tolist()]
        positions, quats = np.empty((frames.size, 3)), np.empty((frames.size, 4))
        for at in rows_by_label(recording):  # motion is never linked across recordings
            path = greedy([intervals[t] for t in at], [moved[t] for t in at], times[at])
            positions[at], quats[at] = path.positions_xyz, path.orientations_quat_wxyz
        return OdometryRun(
            frames=frames,
            timestamps_s=times,
            localization=localization,
            candidates=interval_candidates(proba, regions),
            motions=moved,
            submaps=[],
            trajectories={self.answer: Trajectory(times, positions, quats)},
            unreadable=motions.unreadable,
            answer=self.answer,
        )


def _localize(model: PoseModel, features: Float32Array) -> Localization:
    """Regions of n images as the paper has them: sets of bins, whatever the image."""
    beliefs = model.localizer.beliefs(FrameEvidence(features))
    n = len(features)
    kinds, rule = np.full(n, EvidenceType.GLOBAL, dtype=np.int64), model.calibration
    supports = [Support.of(m.candidates, rule.bins, model.sign_reference) for m in beliefs.mixtures]
    regions = pose_regions(rule, beliefs.proba, supports, rule.thresholds_)
    return Localization(beliefs, regions, np.full(n, np.nan), kinds)


def odometry_of(model: PoseModel) -> Odometry:
    """The system that runs a model, by the model's method."""
    return PaperOdometry(model) if model.method is Method.PAPER else VisualOdometry(model)
