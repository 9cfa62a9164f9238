"""The estimator: from frames to regions, places and a trajectory."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from conformodal.core.arrays import Float32Array, IntArray, UInt8Array, rows_by_label
from conformodal.core.progress import StageProgress
from conformodal.features.local import extract_local_features
from conformodal.geometry import RelativeMotion, Trajectory, concatenate
from conformodal.io import Recording
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import PoseFilter, Posterior, Window, hindsight_posteriors
from conformodal.localizer.places import choose_places, find_places
from conformodal.localizer.prior import MotionPrior
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.settings import FILTER
from conformodal.tracking.flow import affine_flow
from conformodal.tracking.frontend import MotionFrontEnd
from conformodal.tracking.motions import MotionRecord, measure_motions

from .config import Method
from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .model import HINDSIGHT, LAGGED, ONLINE, Localization, PoseModel
from .odometry import Odometry
from .paths import METHODS, as_trajectory, whole_paths
from .store import load_model


class VisualOdometry(Odometry):
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole sequence (:meth:`run`).

    ``examples/stream.py`` answers a camera or a video frame by frame, ``examples/images.py`` a whole data set.

    Parameters
    ----------
    model
        Trained and calibrated.
    lag
        Frames of a stream that :attr:`Estimate.revised` and :meth:`lagged` go back. :meth:`run` uses all.

    Raises
    ------
    OdometryError
        If the model is the paper's, which :class:`PaperOdometry` runs.
    """

    answer = METHODS[0]
    whole_paths = True  # better answers than those of a stream follow, from whole paths

    def __init__(self, model: PoseModel, lag: int = FILTER.lag) -> None:
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self.lag = lag
        self._filter = PoseFilter(model.prior, lag)
        self._last: deque[Estimate] = deque(maxlen=lag + 1)
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
        self._filter.reset()
        self._last.clear()
        self._seen_s = self._shown_s = None

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        features = self.model.backbone.features_of(image)
        motion = self._front_end.measure(image)
        local = []
        if self.model.looks_at_local_features:
            local = [extract_local_features(image, self.model.camera)]
            if self._shown_s is not None:
                flow = affine_flow(self._front_end.tracker.step, timestamp_s - self._shown_s, self.model.camera)
                local = [local[0]._replace(flow=flow)]
        found = self.model.localize(FrameEvidence(features, local))
        now = self._push(self._filter, found, motion, timestamp_s)
        now = replace(now, tracks=self._front_end.tracks, corners=self._front_end.corners)
        self._last.append(now)
        return replace(now, revise=partial(_revised, self._filter.window(), self.model.prior))

    def lagged(self) -> Estimate | None:
        """The estimate of the frame `lag` before the newest, from all up to the newest; unusable ones do not count.

        None for the first `lag` frames of a stream; after an unusable one, the same frame as before it. The last `lag`
        frames are not reached: ``revised`` has their poses. Its `path_region` is calibrated for a lag of ten frames:
        None for others, and where the model has no such calibration. `reliable` asks for the same probability as in
        :meth:`step`.
        """
        if len(self._last) <= self.lag:
            return None
        then, posterior = self._last[0], self._filter.window().first(self.model.prior)
        assert then.localization is not None
        path = LAGGED if self.lag == FILTER.lag else ""
        now = self._estimate(then.localization, then.relative_motion, then.timestamp_s, posterior, path)
        return replace(now, tracks=then.tracks, corners=then.corners)

    def _push(
        self, pose_filter: PoseFilter, found: Localization, motion: RelativeMotion | None, timestamp_s: float
    ) -> Estimate:
        """The estimate of the next frame of a stream, from what its image says and how the camera moved."""
        posterior = pose_filter.push(found.candidates[0], motion, timestamp_s, known=bool(found.known[0]))
        return self._estimate(found, motion, timestamp_s, posterior, ONLINE)

    def _estimate(
        self, found: Localization, motion: RelativeMotion | None, timestamp_s: float, posterior: Posterior, path: str
    ) -> Estimate:
        """The estimate of a frame from its posterior; `path` says which frames this rests on."""
        places = find_places(posterior, self.model.prior)
        best = places[0]
        kind, known_p = EvidenceType(int(found.kinds[0])), float(found.known_p[0])
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if kind is EvidenceType.UNKNOWN:
            problems.append(f"like no place that is known (p = {known_p:.2g})")
        if best.probability < self.model.reliable_p:
            problems.append(f"the most probable place has p = {best.probability:.2g}")
        return Estimate(
            timestamp_s=timestamp_s,
            pose=Trajectory(np.array([timestamp_s]), best.position_xyz[None], best.orientation_quat_wxyz[None]),
            region=found.regions,
            path_region=self.model.path_regions(found.beliefs, [posterior], path),
            candidates=found.candidates[0],
            relative_motion=motion,
            reliable=not problems,
            problem="; ".join(problems),
            localization=found,
            estimates=list(found.beliefs.estimates[0]),
            known_p=None if np.isnan(known_p) else known_p,
            evidence=kind,
            position_spread_m=float(np.linalg.norm(best.position_spreads)),
            orientation_spread_rad=best.orientation_spread_rad,
            posterior=posterior,
            places=places,
        )

    def measure_motions(
        self, sequence: Recording, frames: IntArray, progress: StageProgress | None = None
    ) -> MotionRecord:
        """Relative motions, submaps and local features of `frames`."""
        return measure_motions(sequence, frames, progress)

    def _answered(
        self, sequence: Recording, frames: IntArray, features: Float32Array, motions: MotionRecord
    ) -> OdometryRun:
        local = [motions.local_features[i] for i in frames.tolist() if i in motions.local_features]
        found = self.model.localize(FrameEvidence(features, local))
        moved = [motions.motions[i] for i in frames.tolist()]
        times, recording = sequence.timestamps_s[frames], sequence.recording[frames]
        run = OdometryRun(
            frames=frames,
            timestamps_s=times,
            localization=found,
            candidates=found.candidates,
            motions=moved,
            submaps=motions.submaps_of(frames),
            trajectories={},
            unreadable=motions.unreadable,
            reliable_p=self.model.reliable_p,
        )
        prior, n = self.model.prior, len(frames)
        poses = {name: (np.empty((n, 3)), np.empty((n, 4))) for name in METHODS}
        run.certainty = np.empty(n)
        regions: dict[str, list[PoseRegions | None]] = {path: [None] * n for path in (ONLINE, HINDSIGHT)}
        for at in rows_by_label(recording):  # motion is never linked across recordings
            stream, seen = PoseFilter(prior, lag=0), run.observations(at)
            its = [self._push(stream, found.row(i), moved[i], float(times[i])) for i in at.tolist()]
            later = hindsight_posteriors(seen, prior, [one.posterior for one in its if one.posterior is not None])
            online = concatenate([one.pose for one in its if one.pose is not None])
            for name, path in {**whole_paths(later, seen, prior), ONLINE: online}.items():
                poses[name][0][at], poses[name][1][at] = path.positions_xyz, path.orientations_quat_wxyz
            for i, one, posterior in zip(at.tolist(), its, later, strict=True):
                run.certainty[i] = one.places[0].probability
                regions[ONLINE][i] = one.path_region
                regions[HINDSIGHT][i] = self.model.path_regions(found.row(i).beliefs, [posterior], HINDSIGHT)
        run.trajectories = {name: Trajectory(times, p, q) for name, (p, q) in poses.items()}
        parts = {path: [one for one in its if one is not None] for path, its in regions.items()}
        run.path_regions = {path: PoseRegions.concatenate(its) for path, its in parts.items() if its}
        return run


def _revised(window: Window, prior: MotionPrior) -> Trajectory:
    """The poses of the last frames of a stream, in hindsight."""
    path, _ = choose_places(window.hindsight(prior), window.seen.timestamps_s, prior)
    return as_trajectory(path)
