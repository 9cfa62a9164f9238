"""A model on a stream: answers at once, better ones a little later, all of them on disk, in constant memory."""

from __future__ import annotations

import math
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.parallel import release_freed_memory
from conformodal.geometry import RelativeMotion, Trajectory, concatenate
from conformodal.io.streams.frames import Frame, SourceError
from conformodal.localizer.filter import Posterior, hindsight_posteriors
from conformodal.localizer.observations import Observations
from conformodal.localizer.region_rules import EvidenceType
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.results.records import places_of, region_record
from conformodal.pipeline.results.statistics import RegionStatistics
from conformodal.pipeline.results.writer import ResultsWriter
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import Corners

from .estimates import Estimate
from .evaluate import path_coverage_table
from .model import HINDSIGHT, ONLINE, Localization
from .odometry import Odometry
from .paths import whole_paths

# Whole-path answers are worked out for so many frames at a time. The last ones wait for the next window, and that one
# sees as many frames before them: what is further away than a few hundred frames tells nothing of a frame.
WINDOW, OVERLAP = 2000, 300
_PROBLEMS_KEPT = 100
_MOST_BACK = 10  # frames in a row whose time does not go on; more are a clock that was set back


@dataclass(eq=False)
class _Pending:
    """A frame whose final answer is still to come."""

    timestamp_s: float
    found: Localization
    posterior: Posterior
    motion: RelativeMotion | None
    corners: Corners
    truth: Trajectory | None


class StreamRunner:
    """Takes frames one by one and writes what a model makes of them.

    Regions and poses are written as frames come. Whole paths (hindsight, smoothed) follow for a window of
    frames at a time, of which an overlap, less than half of it, waits for the next window; sources of no more than 2000
    frames are one. As a context it ends the thread that answers windows, whatever error ends the stream;
    :meth:`finish` writes. Coverage is measured with the `truth` of the frames `posed` of a data set; None for all.

    Attributes
    ----------
    n_answered, n_unreliable, n_localized, n_unknown
        Frames so far; the last two: those with an absolute pose estimate from landmarks, and those that show no known
        place.
    answered
        Places in the data set of those whose true pose is known.
    known
        Which of the answers these are, counted from 0.
    motion
        How often which motion status.
    problems
        The first hundred frames without an image, by name, and why; `n_problems` counts all.
    windowed
        Whether a recording was too long to be answered as a whole.
    """

    def __init__(
        self,
        odometry: Odometry,
        writer: ResultsWriter,
        *,
        truth: Trajectory | None = None,
        posed: IntArray | None = None,
        window: int = WINDOW,
        overlap: int = OVERLAP,
    ) -> None:
        self.odometry, self.writer = odometry, writer
        self.window, self.overlap = window, overlap
        self.n_answered = self.n_unreliable = self.n_localized = self.n_unknown = self.n_problems = 0
        self.answered: list[int] = []
        self.known: list[int] = []
        self.motion: Counter[str] = Counter()
        self.windowed = False
        self.problems: dict[str, str] = {}
        self._truth = truth
        frames = range(0 if truth is None else len(truth)) if posed is None else posed.tolist()
        self._row = {frame: row for row, frame in enumerate(frames)}
        self._statistics: list[RegionStatistics] = []
        self._path_statistics: dict[str, list[RegionStatistics]] = {ONLINE: [], HINDSIGHT: []}
        self._reliable: list[bool] = []
        self._online: list[Trajectory] = []
        self._pending: list[_Pending] = []
        self._n_written = 0  # of the pending, which stay to tell of those that follow
        self._recording: int | None = None
        self._last: Frame | None = None
        self._n_back = 0  # frames in a row
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="windows")
        self._job: Future[None] | None = None
        odometry.reset()

    @property
    def statistics(self) -> RegionStatistics:
        """Of the regions of all answered frames, if the truth is known and there are any."""
        return RegionStatistics.concatenate(self._statistics)

    @property
    def path_coverage(self) -> dict[str, Any] | None:
        """Of the regions from posteriors; None where the model has none or no truth is known."""
        its = {path: RegionStatistics.concatenate(parts) for path, parts in self._path_statistics.items() if parts}
        if not its or self.truth is None:
            return None
        online, reliable = concatenate(self._online), np.array(self._reliable)
        return path_coverage_table(its, self.odometry.model, online, self.truth, reliable)

    @property
    def truth(self) -> Trajectory | None:
        """True poses of the answered frames that have one; None if none has."""
        if self._truth is None or not self.answered:
            return None
        return self._truth[np.array([self._row[frame] for frame in self.answered])]

    def true_pose(self, frame: Frame) -> Trajectory | None:
        """The true pose of a frame, a trajectory of one; None where it is not known."""
        row = self._row.get(frame.index)
        return None if self._truth is None or row is None else self._truth[row : row + 1]

    def push(self, frame: Frame) -> Estimate | None:
        """Take the next frame; None where it wants no answer, or has no time, which is a problem of that frame alone.

        Raises
        ------
        SourceError
            If its timestamp, and that of ten frames in a row, is not later than the one before.
        """
        if not math.isfinite(frame.timestamp_s):
            self._note(frame, f"timestamp is {frame.timestamp_s} s, expected a finite number")
            return None
        if self._last is not None and not frame.timestamp_s > self._last.timestamp_s:
            what = f"{frame.name} at {frame.timestamp_s} s follows {self._last.name} at {self._last.timestamp_s} s"
            self._n_back += 1
            if self._n_back > _MOST_BACK:
                raise SourceError(f"time goes back: {what}")
            self._note(frame, f"time does not go on: {what}")
            return None
        self._n_back = 0
        if frame.recording != self._recording:
            self._flush(everything=True)
            self.odometry.reset()
            self._recording = frame.recording
        self._last = frame
        if not frame.answer:
            self.odometry.track_only(frame.image, frame.timestamp_s)
            return None
        estimate = self.odometry.step(frame.image, frame.timestamp_s)
        if estimate.region is None:
            self._note(frame, frame.problem or estimate.problem)
        else:
            self._take(frame, estimate)
        return estimate

    def finish(self) -> None:
        """Write the answers that waited for more frames; also what a run that is stopped ends with."""
        self._flush(everything=True)
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)  # the window that is being answered still writes

    def _note(self, frame: Frame, problem: str) -> None:
        self.n_problems += 1
        if len(self.problems) < _PROBLEMS_KEPT:
            self.problems[frame.name] = problem

    def _take(self, frame: Frame, estimate: Estimate) -> None:
        model, motion, region, pose = self.odometry.model, estimate.relative_motion, estimate.region, estimate.pose
        assert region is not None
        assert pose is not None
        assert estimate.localization is not None
        assert estimate.corners is not None
        assert estimate.evidence is not None
        self.n_answered += 1
        self.n_unreliable += not estimate.reliable
        self.n_localized += bool(estimate.estimates)
        if motion is not None:
            self.motion[str(motion.status)] += 1
        self.n_unknown += estimate.evidence is EvidenceType.UNKNOWN
        place_p = estimate.places[0].probability if estimate.places else None
        record = region_record(
            frame.name,
            frame.timestamp_s,
            motion,
            region.intervals(0),
            estimate.known_p,
            estimate.evidence,
            place_p,
            reliable=estimate.reliable,
            places=places_of(region),
            path_places=places_of(estimate.path_region),
        )
        self.writer.region(record)
        here = self.true_pose(frame)
        if here is not None:
            kind = np.array([estimate.evidence])
            self._statistics.append(RegionStatistics.of(region, here, model.sign_reference, kind))
            self.answered.append(frame.index)
            self.known.append(self.n_answered - 1)
            self._reliable.append(estimate.reliable)
            self._online.append(pose)
            self._measure_path(ONLINE, estimate.path_region, here)
        if not self.odometry.whole_paths:  # each answer is the last word
            self.writer.poses(self.odometry.answer, pose)
            return
        self.writer.poses(ONLINE, pose)
        assert estimate.posterior is not None
        image, posterior = estimate.localization, estimate.posterior
        self._pending.append(_Pending(frame.timestamp_s, image, posterior, motion, estimate.corners, here))
        if len(self._pending) >= self.window:
            self.windowed = True
            self._flush(everything=False)

    def _flush(self, *, everything: bool) -> None:
        """Answer the frames that wait, and write all answers but those of the last `overlap` frames, or all."""
        if len(self._pending) == self._n_written:
            self._settle()
            self._pending, self._n_written = [], 0
            return
        pending = self._pending
        done = len(pending) if everything else len(pending) - self.overlap
        kept_from = done if everything else done - self.overlap
        self._settle()  # one window at a time, so that memory stays bounded
        self._job = self._pool.submit(self._answer, pending, slice(self._n_written, done))
        self._pending, self._n_written = pending[kept_from:], done - kept_from
        if everything:
            self._settle()

    def _answer(self, pending: list[_Pending], wanted: slice) -> None:
        """Answer a window, and write some of its frames; in a thread, so that a camera is not kept waiting."""
        model = self.odometry.model
        times = np.array([p.timestamp_s for p in pending])
        submaps = build_submaps([p.corners for p in pending], model.camera)
        known = np.array([p.found.known[0] for p in pending])
        images, motions = [p.found.candidates[0] for p in pending], [p.motion for p in pending]
        seen = Observations(images, motions, times, submaps, known)
        later = hindsight_posteriors(seen, model.prior, [p.posterior for p in pending])
        for name, trajectory in whole_paths(later, seen, model.prior).items():
            self.writer.poses(name, trajectory[wanted])
        for p, posterior in zip(pending[wanted], later[wanted], strict=True):
            if p.truth is not None:
                self._measure_path(HINDSIGHT, model.path_regions(p.found.beliefs, [posterior], HINDSIGHT), p.truth)
        release_freed_memory()

    def _measure_path(self, path: str, region: PoseRegions | None, truth: Trajectory) -> None:
        if region is not None:
            sign = self.odometry.model.sign_reference
            self._path_statistics[path].append(RegionStatistics.of(region, truth, sign))

    def _settle(self) -> None:
        """Wait for the window that is being answered."""
        if self._job is not None:
            self._job.result()
            self._job = None
