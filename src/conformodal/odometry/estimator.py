"""The estimator: from frames to regions, candidates and a trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.datasets import Sequence
from conformodal.motion import MotionFrontEnd, describe
from conformodal.poses import RelativeMotion, Trajectory
from conformodal.reasoning import (
    LAG,
    Candidates,
    OnlineReasoner,
    bridge,
    interval_means,
    online,
    predict_candidates,
    softmax_mean,
)
from conformodal.vision import FeatureCache

from .answers import METHODS, answers, as_trajectory
from .config import Method
from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .frame import as_image, as_time
from .landmarks import Fixes
from .model import PoseModel
from .motions import MotionRecord, Progress, measure_motions
from .reading import chosen_frames, read_frames
from .region_rules import Evidence, trusted, trusted_only
from .store import load_model

IntArray = npt.NDArray[np.int64]


class VisualOdometry:
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole sequence (:meth:`run`).

    Parameters
    ----------
    model
        Trained and calibrated.
    lag
        Frames of a stream whose answer may still change, see :attr:`Estimate.revised`. :meth:`run` waits for the end.
    fix_every
        Landmarks are looked for in every so many frames of a stream: it takes time, and motion bridges a few frames.
        Regions of the others are wider, those of the image's softmax alone. :meth:`run` looks in all.

    Raises
    ------
    OdometryError
        If `fix_every` is less than 1, or the model is the paper's, which :class:`PaperOdometry` runs.
    """

    answer = METHODS[0]
    whole_paths = True  # better answers than those of a stream follow, from whole paths

    def __init__(self, model: PoseModel, lag: int = LAG, fix_every: int = 1) -> None:
        if fix_every < 1:
            raise OdometryError(f"fix_every must be at least 1, got {fix_every}")
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self.lag = lag
        self.fix_every = fix_every
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
        prepared = self.model.backbone.prepare(image)[None]
        # rounded as the cache rounds, so that a stream and a data set give the same numbers
        features = self.model.backbone.describe(prepared).astype(np.float32)
        proba = self.model.proba(features)
        search = self.model.search(features)
        fixes = self._fixes(image)
        known_p = self.model.known_p(features)
        looked = None if fixes is None else [fixes]
        region = self.model.regions(proba, looked, known_p=known_p)
        kind = Evidence(int(self.model.kinds(known_p, looked)[0]))
        here = self.model.candidates(search, looked)[0]
        motion = self._front_end.measure(image)
        if kind is Evidence.UNKNOWN and self._before is not None and self._last_s is not None:
            here = predict_candidates(self._before, motion, timestamp_s - self._last_s, self.model.prior)
            here = self.model.with_fixes(here, [] if fixes is None else trusted_only(fixes.search))
        path = self._reasoner.push(here, motion, timestamp_s)
        # nothing follows from an unknown first frame, unless landmarks are trusted in it
        landed = fixes is not None and bool(trusted_only(fixes.search))
        if kind is not Evidence.UNKNOWN or self._before is not None or landed:
            self._before = here
        self._last_s = timestamp_s
        revised = as_trajectory(path)
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if kind is Evidence.UNKNOWN:
            problems.append(f"like no place that is known (p = {known_p[0]:.2g})")
        return Estimate(
            timestamp_s,
            revised[-1:],
            revised,
            region,
            here,
            motion,
            not problems,
            "; ".join(problems),
            features[0],
            proba,
            search,
            self._front_end.tracks,
            self._front_end.corners,
            [] if fixes is None else fixes.search,
            None if np.isnan(known_p[0]) else float(known_p[0]),
            kind,
            float(np.linalg.norm(path.position_spreads[-1])),
            float(path.orientation_spreads_rad[-1]),
        )

    def _fixes(self, image: npt.NDArray[np.uint8]) -> Fixes | None:
        due = self._n_steps % self.fix_every == 0
        self._n_steps += 1
        if not due or (self.model.landmarks is None and self.model.region_landmarks is None):
            return None
        return self.model.fixes(describe(image, self.model.camera))

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
        progress: Progress | None = None,
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
        proba = self.model.proba(features)
        search = self.model.search(features)
        fixes = [self.model.fixes(motions.described[i]) for i in usable.tolist()]
        places = {frame: k for k, frame in enumerate(usable.tolist())}
        known_p = self.model.known_p(features)
        found = [motions.motions[i] for i in usable.tolist()]
        kinds, candidates = self.model.kinds(known_p, fixes), self.model.candidates(search, fixes)
        for number in np.unique(sequence.recording[usable]):
            at = np.flatnonzero(sequence.recording[usable] == number)
            own = self._bridged(
                [candidates[t] for t in at],
                kinds[at] != Evidence.UNKNOWN,
                [found[t] for t in at],
                sequence.timestamps_s[usable[at]],
                [fixes[t] for t in at],
            )
            for t, here in zip(at.tolist(), own, strict=True):
                candidates[t] = here
        run = OdometryRun(
            frames=usable,
            timestamps_s=sequence.timestamps_s[usable],
            regions=self.model.regions(proba, fixes, known_p=known_p),
            known_p=known_p,
            kinds=kinds,
            candidates=candidates,
            motions=found,
            submaps=[s for submap in motions.submaps if (s := submap.renumbered(places)) is not None],
            fixes=fixes,
            trajectories={},
            unreadable=motions.unreadable,
        )
        run.trajectories = self._trajectories(run, proba, search.proba, sequence.recording[usable])
        return run

    def _bridged(
        self,
        candidates: list[Candidates],
        known: npt.NDArray[np.bool_],
        motions: list[RelativeMotion | None],
        timestamps_s: npt.NDArray[np.float64],
        fixes: list[Fixes],
    ) -> list[Candidates]:
        """Frames of one recording that show nothing known have their neighbours' candidates, and trusted fixes."""
        if not known.any():  # then the path starts from frames in which landmarks are trusted
            known = trusted([its.search for its in fixes])

        def seen(t: int, here: Candidates) -> Candidates:
            return self.model.with_fixes(here, trusted_only(fixes[t].search))

        return bridge(candidates, known, motions, timestamps_s, self.model.prior, seen)

    def _trajectories(
        self,
        run: OdometryRun,
        proba: list[npt.NDArray[Any]],
        search: list[npt.NDArray[Any]],
        recording: IntArray,
    ) -> dict[str, Trajectory]:
        mean = softmax_mean(search, self.model.bins)
        paper = interval_means(proba, self.model.calibration.predict(proba))
        poses = {name: (np.empty((len(run.frames), 3)), np.empty((len(run.frames), 4))) for name in METHODS}
        prior = self.model.prior
        for number in np.unique(recording):  # motion is never linked across recordings
            at = np.flatnonzero(recording == number)
            seen = run.observations(at)
            found = answers(seen, [paper[t] for t in at], mean[at], prior)
            found["online"] = as_trajectory(online(seen, prior, self.lag))
            for name, path in found.items():
                poses[name][0][at], poses[name][1][at] = path.positions_xyz, path.orientations_quat_wxyz
        return {name: Trajectory(run.timestamps_s, p, q) for name, (p, q) in poses.items()}
