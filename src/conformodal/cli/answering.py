"""Answering a stream: each frame is answered, written and shown; then come the numbers and the page."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.io.streams.frames import Frame, FrameStream, SourceError
from conformodal.io.streams.prefetch import Pace, prefetch
from conformodal.io.streams.stored import RecordingStream
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.evaluate import coverage_table, error_table, is_exchangeable, radius_table
from conformodal.pipeline.identity import identify, same_poses
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.paper import odometry_of
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import ResultsWriter, record_bounded, write_metrics, write_region_parquet
from conformodal.pipeline.stream import StreamRunner
from conformodal.report.page import PAGE, PageFigure, write_page
from conformodal.report.viewer import Thumbnails, make_viewer

from .console import report_line

INTERRUPTED = "interrupted"
_SAME_CAMERA = 1e-6  # share of the image width that intrinsics may differ by: text files round them


class Part(StrEnum):
    """Which frames of a source to answer."""

    ALL = "all"
    TRAIN = "train"
    CALIBRATION = "calibration"
    TEST = "test"


class FrameSink(Protocol):
    """Receives every frame with its estimate."""

    def log(self, frame: Frame, estimate: Estimate, truth: Trajectory | None = None) -> None:
        """Take a frame; `truth` is a trajectory of one, or None."""
        ...


@dataclass(eq=False)
class Answers:
    """Answers to a stream, as they are in its folder of results."""

    model: PoseModel
    part: Part
    runner: StreamRunner
    writer: ResultsWriter
    trajectories: dict[str, Trajectory]  # by method, the answer first
    pictures: dict[str, bytes]  # JPEG by frame name
    stopped: str  # why the stream ended early, if it did
    whole: bool  # whether each frame of the part was answered, as in calibration: the guarantee holds for these only
    seconds: float


def part_frames(model: PoseModel, sequence: Recording, part: Part) -> IntArray | None:
    """Where the frames of a part of the model's own data set are in a sequence, increasing; None for all.

    They are recognised by their files. Those that the sequence lacks are left out, and their number is printed.
    """
    if part is Part.ALL:
        return None
    rows, here = model.split.part(str(part)), identify(sequence)
    at = model.known_frames.find(here)[rows]
    n, where = counted(len(rows), "frame"), f"the {part} part of {model.configuration['data']}"
    n_missing, rows, at = int((at < 0).sum()), rows[at >= 0], at[at >= 0]
    if not len(at):
        raise OdometryError(f"{sequence.name}: has none of the {n} of {where}; give that data set or run on all")
    try:
        model.check_camera(sequence.camera, _SAME_CAMERA)
    except OdometryError as exc:
        first = sequence.image_paths[at.min()]
        raise OdometryError(f"{first}: is a frame of {where}, but from another camera: {exc}") from None
    other_pose = np.sort(at[~same_poses(model.known_frames.poses[rows], here.poses[at])])
    if len(other_pose):
        first = sequence.image_paths[other_pose[0]]
        raise OdometryError(f"{first}: is a frame of {where}, but has another pose, as {len(other_pose)} of {n} have")
    if n_missing:
        report_line(f"{n_missing} of {n} of {where} are not in {sequence.name}")
    return np.sort(at)


def answer_stream(
    model: PoseModel,
    stream: FrameStream,
    out: Path,
    report: StageProgress,
    *,
    part: Part = Part.ALL,
    pace: Pace = Pace.FAST,
    limit: int | None = None,
    sinks: Sequence[FrameSink] = (),
    signals: Sequence[int] = (),
) -> Answers:
    """Answer the frames of a stream, and write regions and trajectories into a folder.

    Once `signals` is not empty, the stream is ended; all answers until then are kept.
    """
    sequence = stream.sequence if isinstance(stream, RecordingStream) else None
    truth, posed = (None, None) if sequence is None else (sequence.poses, sequence.posed)
    odometry, pictures = odometry_of(model), Thumbnails()
    started, number, stopped = time.perf_counter(), 0, ""
    with ResultsWriter(out, answer=odometry.answer) as writer:
        with StreamRunner(odometry, writer, truth=truth, posed=posed) as runner:
            try:
                with closing(prefetch(stream, pace=pace)) as frames:
                    for number, frame in enumerate(frames, start=1):
                        estimate = runner.push(frame)
                        if estimate is not None:
                            for sink in sinks:
                                sink.log(frame, estimate, runner.true_pose(frame))
                            report("frames", number, stream.n_frames or 0)
                        if estimate is not None and estimate.region is not None and frame.image is not None:
                            pictures.add(frame.name, frame.image)
                        if signals or number == limit:
                            break
            except SourceError as exc:
                stopped = str(exc)
            stopped = INTERRUPTED if signals and not stopped else stopped
            runner.finish()
        if not runner.n_answered:
            first = next(iter(runner.problems.values()), "it holds no frame")
            raise OdometryError(f"{stream.name}: no frame could be answered: {stopped or first}")
        if runner.truth is not None:
            writer.truth(runner.truth)
    whole = not (stopped or number == limit or stream.live or pace is Pace.CAMERA or runner.windowed)
    seconds, paths = round(time.perf_counter() - started, 2), dict(runner.trajectories)
    return Answers(model, part, runner, writer, paths, pictures.jpegs, stopped, whole, seconds)


def metrics_of(answers: Answers) -> dict[str, Any]:
    """The content of ``metrics.json``."""
    model, runner, part = answers.model, answers.runner, answers.part
    n_part = runner.n_answered
    note = "all frames of the source (training frames among them, if the source is the training data)."
    if part is not Part.ALL:
        n_part = len(model.split.part(str(part)))
        some = "" if runner.n_answered == n_part else f"{runner.n_answered} of {counted(n_part, 'frame')} of "
        note = f"{some}the {part} part of split {model.split.kind}, seed {model.split.seed}."
    metrics: dict[str, Any] = {
        "command": "run",
        "provenance": provenance(),
        "configuration": {**model.settings, "part": str(part)},
        "seed": model.split.seed,
        "sign_reference_quat_wxyz": model.sign_reference.tolist(),
        "split": str(model.split.kind),
        "split_note": note,
        "n_answered": runner.n_answered,
        "results": answers.writer.digests,
        "n_unreliable": runner.n_unreliable,
        "n_localized": runner.n_localized,
        "n_unknown": runner.n_unknown,
        "n_unbounded": sum(not record_bounded(one) for one in answers.writer.records) - runner.n_unknown,
        "n_without_image": runner.n_problems,
        "problems": runner.problems,
        "motion": dict(sorted(runner.motion.items())),
        "stopped": answers.stopped,
        "seconds": answers.seconds,
    }
    truth, paths, whole = runner.truth, answers.trajectories, answers.whole
    rows = None if truth is None else np.array(runner.known)
    # whole recordings calibrated it: some of a recording's frames alone are answered otherwise, and it tells nothing
    radius = model.radius if whole and part is Part.ALL else None
    metrics["radius"] = radius_table(radius, paths, truth, rows)
    if truth is not None and rows is not None:
        paths = {name: path[rows] for name, path in paths.items()}
        recognised = runner.statistics.kinds != EvidenceType.UNKNOWN
        metrics |= {"n_with_truth": len(truth), "errors": error_table(paths, truth)}
        if recognised.any() and not recognised.all():
            subset = {name: path[recognised] for name, path in paths.items()}
            metrics["errors_known_places"] = error_table(subset, truth[recognised])
        exchangeable = whole and part is not Part.ALL and runner.n_answered == n_part
        metrics["coverage"] = coverage_table(
            runner.statistics,
            model,
            exchangeable=exchangeable and is_exchangeable(model, str(part)),
            seen=part in (Part.TRAIN, Part.CALIBRATION),
        )
        metrics["path_coverage"] = runner.path_coverage
    return metrics


def write_answers(
    answers: Answers,
    metrics: dict[str, Any],
    title: str,
    summary: list[str],
    figures: Sequence[PageFigure] = (),
    walls: Sequence[FloatArray] = (),
) -> None:
    """Write metrics, Parquet where it can be written, and the page."""
    folder, records, runner = answers.writer.folder, answers.writer.records, answers.runner
    write_metrics(folder, metrics)
    if find_spec("pyarrow"):  # an extra
        write_region_parquet(folder, records)
    level = answers.model.rules.level
    viewer = make_viewer(records, answers.trajectories, runner.truth, answers.pictures, level, walls)
    write_page(folder / PAGE, title, summary, metrics, figures, viewer)
