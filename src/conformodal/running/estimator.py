"""The estimator: from frames to regions, candidates and a trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import IntArray
from conformodal.core.progress import StageProgress
from conformodal.core.ranges import check_ranges
from conformodal.datasets import Sequence
from conformodal.localization.belief import recognised_only
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.local_features import LocalFeatures, extract_local_features
from conformodal.model.config import Method
from conformodal.model.errors import OdometryError
from conformodal.model.model import Localization, PoseModel
from conformodal.model.region_rules import EvidenceType
from conformodal.model.store import load_model
from conformodal.motion.frontend import MotionFrontEnd
from conformodal.poses import RelativeMotion, Trajectory
from conformodal.reasoning.bridging import blend, bridge, predict_candidates
from conformodal.reasoning.candidates import Candidates
from conformodal.reasoning.observations import Observations
from conformodal.reasoning.online import LAG, OnlineReasoner, online

from .estimates import Estimate, OdometryRun
from .motions import MotionRecord, measure_motions
from .odometry import Odometry
from .paths import METHODS, ONLINE, as_trajectory, rows_by_recording, whole_paths


class VisualOdometry(Odometry):
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole sequence (:meth:`run`).

    ``examples/stream.py`` answers a camera or a video frame by frame, ``examples/images.py`` a whole data set.

    Parameters
    ----------
    model
        Trained and calibrated.
    lag
        Frames of a stream whose answer may still change, see :attr:`Estimate.revised`. :meth:`run` waits for the end.
    match_every
        Local features are matched in every so many frames of a stream: it takes time, and motion bridges a few frames.
        Regions of the others are wider. :meth:`run` matches them in all.

    Raises
    ------
    OdometryError
        If `match_every` is less than 1, or the model is the paper's, which :class:`PaperOdometry` runs.
    """

    answer = METHODS[0]
    whole_paths = True  # better answers than those of a stream follow, from whole paths

    def __init__(self, model: PoseModel, lag: int = LAG, match_every: int = 1) -> None:
        check_ranges({"match_every": match_every}, OdometryError)
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self.lag = lag
        self.match_every = match_every
        self._reasoner = OnlineReasoner(model.prior, lag)
        self.reset()

    @classmethod
    def load(cls, folder: Path | str) -> VisualOdometry:
        """Load a saved model.

        Raises
        ------
        ModelFileError
            If the model is missing, damaged or altered.
        """
        return cls(load_model(folder))

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = MotionFrontEnd(self.model.camera)
        self._reasoner.reset()
        self._seen_s = None
        self._last_s: float | None = None  # of the frame answered last
        self._n_steps = 0
        self._before: Candidates | None = None

    def _answer(self, image: npt.NDArray[np.uint8], timestamp_s: float) -> Estimate:
        features = self.model.backbone.features_of(image)
        local = self._local_features(image)
        found = self.model.localize(FrameEvidence(features, [local]))
        motion = self._front_end.measure(image)
        step_s = None if self._last_s is None else timestamp_s - self._last_s
        here, self._before = self._candidates(found, 0, self._before, motion, step_s)
        path = self._reasoner.push(here, motion, timestamp_s)
        self._last_s = timestamp_s
        revised = as_trajectory(path)
        kind, known_p = EvidenceType(int(found.kinds[0])), float(found.known_p[0])
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if kind is EvidenceType.UNKNOWN:
            problems.append(f"like no place that is known (p = {known_p:.2g})")
        return Estimate(
            timestamp_s,
            revised[-1:],
            revised,
            found.regions,
            here,
            motion,
            not problems,
            "; ".join(problems),
            found,
            self._front_end.tracks,
            self._front_end.corners,
            list(found.beliefs.estimates[0]),
            None if np.isnan(known_p) else known_p,
            kind,
            float(np.linalg.norm(path.position_spreads[-1])),
            float(path.orientation_spreads_rad[-1]),
            local is not None,
        )

    def _candidates(
        self,
        found: Localization,
        t: int,
        before: Candidates | None,
        motion: RelativeMotion | None,
        step_s: float | None,
    ) -> tuple[Candidates, Candidates | None]:
        """Candidates of frame t, and what the next frame's are predicted from.

        Where it shows no known place, those predicted from the frame before are added.
        """
        here, estimates = found.candidates[t], list(found.beliefs.estimates[t])
        known, chain = bool(found.known[t]), found.candidates[t]
        if not known and before is not None and step_s is not None:
            predicted = predict_candidates(before, motion, step_s, self.model.prior)
            chain = self.model.with_recognised(predicted, estimates)
            here = blend(here, chain)
        # nothing follows from an unknown first frame, unless a place was recognised in it
        return here, chain if known or before is not None or recognised_only(estimates) else None

    def _local_features(self, image: npt.NDArray[np.uint8]) -> LocalFeatures | None:
        due = self._n_steps % self.match_every == 0
        self._n_steps += 1
        if not (due and self.model.looks_at_local_features):
            return None
        return extract_local_features(image, self.model.camera)

    def measure_motions(
        self, sequence: Sequence, frames: IntArray, progress: StageProgress | None = None
    ) -> MotionRecord:
        """Relative motions, submaps and local features of `frames`."""
        return measure_motions(sequence, frames, progress)

    def _answered(
        self, sequence: Sequence, frames: IntArray, features: npt.NDArray[np.float32], motions: MotionRecord
    ) -> OdometryRun:
        local = [motions.local_features.get(i) for i in frames.tolist()]
        found = self.model.localize(FrameEvidence(features, local))
        moved = [motions.motions[i] for i in frames.tolist()]
        times, recording = sequence.timestamps_s[frames], sequence.recording[frames]
        run = OdometryRun(
            frames=frames,
            timestamps_s=times,
            localization=found,
            candidates=self._bridged(found, moved, times, recording),
            motions=moved,
            submaps=motions.submaps_of(frames),
            trajectories={},
            unreadable=motions.unreadable,
        )
        run.trajectories = self._trajectories(run, recording)
        return run

    def _bridged(
        self,
        found: Localization,
        motions: list[RelativeMotion | None],
        timestamps_s: npt.NDArray[np.float64],
        recording: IntArray,
    ) -> list[Candidates]:
        """Candidates of all frames; where one shows no known place, those predicted from its neighbour are added."""
        candidates, estimates = found.candidates, found.beliefs.estimates
        for at in rows_by_recording(recording):
            known = found.known[at]
            if not known.any():  # then the path starts from frames in which a place was recognised
                known = found.beliefs.recognised[at]

            def seen(t: int, here: Candidates, at: IntArray = at) -> Candidates:
                return self.model.with_recognised(here, list(estimates[at[t]]))

            own = [candidates[t] for t in at]
            bridged = bridge(own, known, [motions[t] for t in at], timestamps_s[at], self.model.prior, seen)
            for t, here in zip(at.tolist(), bridged, strict=True):
                candidates[t] = here
        return candidates

    def _trajectories(self, run: OdometryRun, recording: IntArray) -> dict[str, Trajectory]:
        poses = {name: (np.empty((len(run.frames), 3)), np.empty((len(run.frames), 4))) for name in METHODS}
        prior = self.model.prior
        for at in rows_by_recording(recording):
            found = {**whole_paths(run.observations(at), prior), ONLINE: self._online(run, at)}
            for name, path in found.items():
                poses[name][0][at], poses[name][1][at] = path.positions_xyz, path.orientations_quat_wxyz
        return {name: Trajectory(run.timestamps_s, p, q) for name, (p, q) in poses.items()}

    def _online(self, run: OdometryRun, at: IntArray) -> Trajectory:
        """The poses that :meth:`step` would have given in one recording: each from the frames so far alone."""
        seen, motions, before = [], [run.motions[t] for t in at], None
        steps: list[float | None] = [None, *np.diff(run.timestamps_s[at]).tolist()]
        for t, motion, step_s in zip(at.tolist(), motions, steps, strict=True):
            here, before = self._candidates(run.localization, t, before, motion, step_s)
            seen.append(here)
        return as_trajectory(online(Observations(seen, motions, run.timestamps_s[at]), self.model.prior, lag=0))
