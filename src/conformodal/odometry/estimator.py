"""The estimator: from frames to regions, candidates and a trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.core import IntArray, StageProgress
from conformodal.datasets import Sequence
from conformodal.localization import FrameEvidence, LocalFeatures, extract_local_features, recognised_only
from conformodal.motion import MotionFrontEnd
from conformodal.poses import RelativeMotion, Trajectory
from conformodal.reasoning import LAG, Candidates, OnlineReasoner, blend, bridge, online, predict_candidates
from conformodal.vision import FeatureCache

from .budget import FrameBudget, as_budget
from .config import Method
from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .frame import as_image, as_time
from .model import Localization, PoseModel
from .motions import MotionRecord, measure_motions
from .paths import METHODS, as_trajectory, whole_paths
from .reading import chosen_frames, read_frames
from .region_rules import EvidenceKind
from .store import load_model


class VisualOdometry:
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole sequence (:meth:`run`).

    Parameters
    ----------
    model
        Trained and calibrated.
    lag
        Frames of a stream whose answer may still change, see :attr:`Estimate.revised`. :meth:`run` waits for the end.
    match_every
        Local features are matched in every so many frames of a stream: it takes time, and motion bridges a few frames.
        Regions of the others are wider. :meth:`run` matches them in all.
    budget_ms
        Milliseconds that the answer to a frame of a stream may take, or a :class:`~conformodal.odometry.FrameBudget`:
        local features are matched in fewer frames, or in none, where this keeps it. :meth:`run` does without.

    Raises
    ------
    OdometryError
        If `match_every` is less than 1, `budget_ms` is not positive, or the model is the paper's, which
        :class:`PaperOdometry` runs.
    """

    answer = METHODS[0]
    whole_paths = True  # better answers than those of a stream follow, from whole paths

    def __init__(
        self, model: PoseModel, lag: int = LAG, match_every: int = 1, budget_ms: float | FrameBudget | None = None
    ) -> None:
        if match_every < 1:
            raise OdometryError(f"match_every must be at least 1, got {match_every}")
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self.lag = lag
        self.match_every = match_every
        self.budget = None if budget_ms is None else as_budget(budget_ms)
        self._reasoner = OnlineReasoner(model.prior, lag)
        self.reset()

    @classmethod
    def load(cls, folder: Path | str) -> VisualOdometry:
        """From a saved model.

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
        self._last_s: float | None = None
        self._n_steps = 0
        self._before: Candidates | None = None

    def step(self, image: npt.ArrayLike | None, timestamp_s: float) -> Estimate:
        """Take the next frame of a stream, (height, width, 3) RGB, or None where the camera gave none.

        The pose is the best given all frames so far, and `revised` those before it, better known by now;
        :meth:`run` also uses the frames after. A frame that cannot be used does not end the stream: the answer says
        so.

        Raises
        ------
        OdometryError
            If the timestamp is not finite, or not later than the one before; nothing has changed then.
        """
        timestamp_s = as_time(timestamp_s, self._last_s)
        image = as_image(image, self.model.camera)
        if isinstance(image, str):
            return Estimate(timestamp_s, None, None, None, None, None, False, image)
        if self.budget is None:
            return self._answer(image, timestamp_s)
        self.budget.start()
        estimate = self._answer(image, timestamp_s)
        self.budget.stop(matched=estimate.matched)
        return estimate

    def _answer(self, image: npt.NDArray[np.uint8], timestamp_s: float) -> Estimate:
        features = self.model.backbone.features_of(image)
        local = self._local_features(image)
        found = self.model.localize(FrameEvidence(features, [local]))
        motion = self._front_end.measure(image)
        here = self._candidates(found, motion, timestamp_s)
        path = self._reasoner.push(here, motion, timestamp_s)
        self._last_s = timestamp_s
        revised = as_trajectory(path)
        kind, known_p = EvidenceKind(int(found.kinds[0])), float(found.known_p[0])
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if kind is EvidenceKind.UNKNOWN:
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

    def _candidates(self, found: Localization, motion: RelativeMotion | None, timestamp_s: float) -> Candidates:
        """Candidates of a frame; those of the frame before, moved on, are added where it shows nothing known."""
        here, estimates = found.candidates[0], list(found.beliefs.estimates[0])
        known, chain = bool(found.known[0]), found.candidates[0]
        if not known and self._before is not None and self._last_s is not None:
            predicted = predict_candidates(self._before, motion, timestamp_s - self._last_s, self.model.prior)
            chain = self.model.with_recognised(predicted, estimates)
            here = blend(here, chain)
        # nothing follows from an unknown first frame, unless a place was recognised in it
        if known or self._before is not None or recognised_only(estimates):
            self._before = chain
        return here

    def _local_features(self, image: npt.NDArray[np.uint8]) -> LocalFeatures | None:
        due = self._n_steps % self.match_every == 0
        self._n_steps += 1
        due = due and (self.budget is None or self.budget.has_room)
        if not (due and self.model.looks_at_local_features):
            return None
        return extract_local_features(image, self.model.camera)

    def pass_by(self, image: npt.ArrayLike) -> None:
        """Show a frame of the stream that wants no answer: corners are followed through it, if it is an image."""
        found = as_image(image, self.model.camera)
        if not isinstance(found, str):
            self._front_end.pass_by(found)

    def run(self, sequence: Sequence) -> Trajectory:
        """The smoothed trajectory of a whole sequence; :meth:`process` gives all the rest."""
        return self.process(sequence).trajectory

    def process(
        self,
        sequence: Sequence,
        frames: IntArray | None = None,
        *,
        cache: FeatureCache | None = None,
        motions: MotionRecord | None = None,
        progress: StageProgress | None = None,
    ) -> OdometryRun:
        """Work out regions and trajectories of a sequence.

        Parameters
        ----------
        sequence
            Frames in order of time, of the model's camera.
        frames
            Frames to answer, increasing; all by default. The network sees these only. The tracker also follows
            corners through the frames between them, as a camera would deliver them.
        cache
            Of features.
        motions
            From :func:`measure_motions` on the same frames, if they are known already.
        progress
            Called with stage, frames done and frames in all.

        Raises
        ------
        OdometryError
            If no frame can be read, the camera is another one, or `frames` are not increasing indices of frames.
        """
        if motions is None:
            motions = measure_motions(sequence, chosen_frames(self.model, sequence, frames), progress)
        usable, features = read_frames(self.model, sequence, frames, motions, cache, progress)
        local = [motions.local_features.get(i) for i in usable.tolist()]
        found = self.model.localize(FrameEvidence(features, local))
        moved = [motions.motions[i] for i in usable.tolist()]
        run = OdometryRun(
            frames=usable,
            timestamps_s=sequence.timestamps_s[usable],
            localization=found,
            candidates=self._bridged(found, moved, sequence.timestamps_s[usable], sequence.recording[usable]),
            motions=moved,
            submaps=motions.submaps_of(usable),
            trajectories={},
            unreadable=motions.unreadable,
        )
        run.trajectories = self._trajectories(run, sequence.recording[usable])
        return run

    def _bridged(
        self,
        found: Localization,
        motions: list[RelativeMotion | None],
        timestamps_s: npt.NDArray[np.float64],
        recording: IntArray,
    ) -> list[Candidates]:
        """Candidates of all frames; those that show nothing known have their neighbours', and recognised places."""
        candidates, estimates = found.candidates, found.beliefs.estimates
        for number in np.unique(recording):
            at = np.flatnonzero(recording == number)
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
        for number in np.unique(recording):  # motion is never linked across recordings
            at = np.flatnonzero(recording == number)
            seen = run.observations(at)
            found = {**whole_paths(seen, prior), "online": as_trajectory(online(seen, prior, self.lag))}
            for name, path in found.items():
                poses[name][0][at], poses[name][1][at] = path.positions_xyz, path.orientations_quat_wxyz
        return {name: Trajectory(run.timestamps_s, p, q) for name, (p, q) in poses.items()}
