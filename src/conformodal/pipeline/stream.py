"""A stream through an estimator: answers at once, better ones a little later, in constant memory."""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np

from conformodal.core.arrays import IntArray
from conformodal.core.files import naming_file
from conformodal.core.parallel import release_freed_memory
from conformodal.geometry import Trajectory
from conformodal.io.streams.frames import Frame, SourceError
from conformodal.localizer.filter import hindsight_posteriors
from conformodal.localizer.observations import MotionPrior, Observations, PosePath, Posterior, choose_places
from conformodal.localizer.regions import PoseRegions
from conformodal.localizer.smoother import image_hypotheses, smooth

from .estimates import Estimate, observations_of
from .model import HINDSIGHT, METHODS, ONLINE
from .results import ResultsWriter, record_of
from .stream_scores import StreamScores

if TYPE_CHECKING:
    from .odometry import Odometry  # which answers recordings by a runner

# Whole-path answers are worked out for so many frames at a time. The last ones wait for the next window, and that one
# sees as many frames before them: what is further away than a few hundred frames tells nothing of a frame.
WINDOW, OVERLAP = 2000, 300
_PROBLEMS_KEPT = 100
_MAX_BACK = 10  # frames in a row whose timestamp did not increase; more are a clock that was set back


def whole_paths(posteriors: list[Posterior], observations: Observations, prior: MotionPrior) -> dict[str, Trajectory]:
    """The paths that need all frames of a recording: the most probable place of each frame, and that path smoothed.

    From posteriors in hindsight, and what they were worked out from.
    """
    best = choose_places(posteriors, observations.timestamps_s, prior)
    smoothed = smooth(image_hypotheses(best, observations, prior), observations, prior)
    return {METHODS[0]: as_trajectory(smoothed), HINDSIGHT: as_trajectory(best)}


def as_trajectory(path: PosePath) -> Trajectory:
    """The poses of a path."""
    return Trajectory(path.timestamps_s, path.positions_xyz, path.orientations_quat_wxyz)


class StreamClock:
    """Whether the times of a stream go on, frame by frame."""

    def __init__(self) -> None:
        self._last: Frame | None = None
        self._n_back = 0  # frames in a row

    def check(self, frame: Frame) -> str:
        """Why a frame has no place in time, as that of its own problem; empty if it has.

        Raises
        ------
        SourceError
            If more than ten frames in a row are not later than the last one that is.
        """
        if not math.isfinite(frame.timestamp_s):
            return f"timestamp is {frame.timestamp_s} s, expected a finite number"
        if self._last is not None and not frame.timestamp_s > self._last.timestamp_s:
            what = f"{frame.name} at {frame.timestamp_s} s follows {self._last.name} at {self._last.timestamp_s} s"
            self._n_back += 1
            if self._n_back > _MAX_BACK:
                raise SourceError(f"time goes back: {what}")
            return f"timestamp did not increase: {what}"
        self._n_back, self._last = 0, frame
        return ""


class PoseStore:
    """Poses in the order in which they come, eight numbers each: in an unnamed file of a folder, or in memory."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or Path()
        self._file: IO[bytes] = BytesIO() if folder is None else TemporaryFile(dir=folder)  # noqa: SIM115

    def add(self, poses: Trajectory) -> None:
        """Append poses."""
        rows = (poses.timestamps_s, poses.positions_xyz, poses.orientations_quat_wxyz)
        with naming_file(self._folder):
            self._file.write(np.column_stack(rows).tobytes())

    def read(self) -> Trajectory:
        """All poses so far."""
        with naming_file(self._folder):  # what waits to be written is written first
            self._file.seek(0)
        rows = np.frombuffer(self._file.read()).reshape(-1, 8)
        return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])

    def close(self) -> None:
        """Let go of the file."""
        with naming_file(self._folder):
            self._file.close()


class StreamRunner:
    """Takes frames one by one, answers each, and writes the answers.

    Regions and poses are written as frames come. Whole paths (hindsight, smoothed) follow for a window of
    frames at a time, of which an overlap, less than half of it, waits for the next window; sources of no more than 2000
    frames are one. As a context it ends the thread that answers windows, whatever error ends the stream;
    :meth:`finish` writes.

    The estimator is reset here and at each new recording; `truth` are the true poses of the frames `posed` of a data
    set, None for all, to measure coverage with; `keep_regions` keeps regions in hindsight.
    """

    def __init__(
        self,
        estimator: Odometry,
        writer: ResultsWriter | None = None,
        *,
        truth: Trajectory | None = None,
        posed: IntArray | None = None,
        window: int = WINDOW,
        overlap: int = OVERLAP,
        keep_regions: bool = False,
    ) -> None:
        self.estimator, self.writer = estimator, writer
        self.window, self.overlap = window, overlap
        self.n_answered = self.n_problems = 0  # frames so far
        self.n_localized = 0  # those with an absolute pose estimate from landmarks
        self.scores = StreamScores(estimator.model, truth, posed)
        self.windowed = False  # whether a recording was too long to be answered as a whole
        self.problems: dict[str, str] = {}  # of the first hundred frames without an image, by name
        self.hindsight_regions: list[PoseRegions] = []  # of all frames so far, if they are kept and the model has them
        self._keep_regions = keep_regions
        self._poses: dict[str, PoseStore] = {}
        self._trajectories: dict[str, Trajectory] = {}
        self._pending: list[tuple[Estimate, Trajectory | None]] = []  # with the truth; their final answer is to come
        self._n_written = 0  # of the pending, which stay to tell of those that follow
        self._recording: int | None = None
        self._clock = StreamClock()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="windows")
        self._job: Future[None] | None = None
        estimator.reset()

    @property
    def trajectories(self) -> dict[str, Trajectory]:
        """The poses by method, the answer first, once the stream is finished."""
        return self._trajectories

    @property
    def path_coverage(self) -> dict[str, Any] | None:
        """Of the regions from posteriors; None where the model has none or no truth is known."""
        return self.scores.path_coverage(self.trajectories[ONLINE]) if ONLINE in self.trajectories else None

    def push(self, frame: Frame) -> Estimate | None:
        """Take the next frame; None where it wants no answer, or has no time, which is a problem of that frame alone.

        The timestamps of more than ten frames in a row that are not later than the one before end the stream.
        """
        if problem := self._clock.check(frame):
            self._note(frame, problem)
            return None
        if frame.recording != self._recording:
            self._flush(everything=True)
            self.estimator.reset()
            self._recording = frame.recording
        if not frame.answer:
            self.estimator.track_only(frame.image, frame.timestamp_s)
            return None
        estimate = self.estimator.step(frame.image, frame.timestamp_s)
        if estimate.region is None:
            self._note(frame, frame.problem or estimate.problem)
        else:
            self._append(frame, estimate)
        return estimate

    def finish(self) -> None:
        """Write the answers that waited for more frames; also what a run that is stopped ends with."""
        self._flush(everything=True)
        self._pool.shutdown()
        ordered = sorted(self._poses, key=lambda method: method != self.estimator.answer)
        self._trajectories = {method: self._poses[method].read() for method in ordered}
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(cancel_futures=True)  # the window that is being answered still writes
        self._close()

    def _close(self) -> None:
        for store in self._poses.values():
            store.close()

    def _note(self, frame: Frame, problem: str) -> None:
        self.n_problems += 1
        if len(self.problems) < _PROBLEMS_KEPT:
            self.problems[frame.name] = problem

    def _append(self, frame: Frame, estimate: Estimate) -> None:
        """Count, measure and write an answer, and queue it for the whole path."""
        assert estimate.pose is not None
        pose = estimate.pose.at(estimate.timestamp_s)
        self.n_answered += 1
        self.n_localized += bool(estimate.estimates)
        truth = self.scores.true_pose(frame)
        if self.writer is not None:
            score = None if truth is None else self.scores.score(estimate, truth)
            self.writer.region(record_of(frame.name, estimate, score, frame.recording))
        if truth is not None:
            self.scores.add(self.n_answered - 1, estimate, truth)
        if not self.estimator.whole_paths:  # each answer is the last word
            self._add_poses(self.estimator.answer, pose)
            return
        self._add_poses(ONLINE, pose)
        self._pending.append((estimate, truth))
        if len(self._pending) >= self.window:
            self.windowed = True
            self._flush(everything=False)

    def _add_poses(self, method: str, trajectory: Trajectory) -> None:
        if method not in self._poses:
            self._poses[method] = PoseStore(None if self.writer is None else self.writer.folder)
        self._poses[method].add(trajectory)
        if self.writer is not None:
            self.writer.poses(method, trajectory)

    def _flush(self, *, everything: bool) -> None:
        """Answer the frames that wait, and write all answers but those of the last `overlap` frames, or all."""
        if len(self._pending) == self._n_written:
            self._finish_window()
            self._pending, self._n_written = [], 0
            return
        pending = self._pending
        done = len(pending) if everything else len(pending) - self.overlap
        kept_from = done if everything else done - self.overlap
        self._finish_window()  # one window at a time, so that memory stays bounded
        self._job = self._pool.submit(self._answer_window, pending, slice(self._n_written, done))
        self._pending, self._n_written = pending[kept_from:], done - kept_from
        if everything:
            self._finish_window()

    def _answer_window(self, pending: list[tuple[Estimate, Trajectory | None]], wanted: slice) -> None:
        """Answer a window, and write some of its frames; in a thread, so that a camera is not kept waiting."""
        model = self.estimator.model
        observations = observations_of([estimate for estimate, _ in pending], model)
        forward = [estimate.posterior for estimate, _ in pending if estimate.posterior is not None]
        posteriors = hindsight_posteriors(observations, model.prior, forward)
        for method, trajectory in whole_paths(posteriors, observations, model.prior).items():
            self._add_poses(method, trajectory[wanted])
        for (estimate, truth), posterior in zip(pending[wanted], posteriors[wanted], strict=True):
            if (truth is None and not self._keep_regions) or estimate.localization is None:
                continue
            region = model.path_regions(estimate.localization, [posterior], HINDSIGHT)
            if self._keep_regions and region is not None:
                self.hindsight_regions.append(region)
            if truth is not None:
                self.scores.add_path(HINDSIGHT, region, truth)
        release_freed_memory()

    def _finish_window(self) -> None:
        """Wait for the window that is being answered."""
        if self._job is not None:
            self._job.result()
            self._job = None
