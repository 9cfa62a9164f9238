"""Answering a stream: each frame is answered, written and shown; then come the numbers, in words, and the page."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.progress import StageProgress
from conformodal.core.words import counted, length, noun_for
from conformodal.geometry import Trajectory
from conformodal.io import Recording
from conformodal.io.streams.frames import Frame, FrameStream, RecordingStream, SourceError, prefetch
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.evaluate import coverage_table, error_table
from conformodal.pipeline.guarantee import short_guarantee
from conformodal.pipeline.identity import identify, same_poses
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.provenance import provenance
from conformodal.pipeline.results import PAGE, ResultsWriter, record_bounded, record_size
from conformodal.pipeline.stream import StreamRunner
from conformodal.report.page import METHOD_LABELS, write_page
from conformodal.report.viewer import Surroundings, Thumbnails, make_viewer

from .console import report_line

INTERRUPTED = "interrupted"
_SAME_CAMERA = 1e-6  # share of the image width that intrinsics may differ by: text files round them


class Part(StrEnum):
    """Which frames of a source to answer."""

    ALL = "all"
    TEST = "test"


@dataclass(frozen=True)
class StopWhen:
    """What ends a stream before its last frame; all answers until then are kept."""

    limit: int | None = None  # frames
    signals: Sequence[int] = ()  # that came so far: it ends once there is one


# takes every frame with its estimate, and its true pose, a trajectory of one, or None
FrameSink: TypeAlias = Callable[[Frame, Estimate, Trajectory | None], None]


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
    rows, here = model.split.test, identify(sequence)
    at = model.known_frames.find(here)[rows]
    n, where = counted(len(rows), "frame"), f"the test part of {model.configuration['data']}"
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
    sinks: Sequence[FrameSink] = (),
    stop: StopWhen | None = None,
) -> Answers:
    """Answer the frames of a stream, until its end or until it is stopped, and write regions and trajectories."""
    stop = StopWhen() if stop is None else stop
    sequence = stream.sequence if isinstance(stream, RecordingStream) else None
    truth, posed = (None, None) if sequence is None else (sequence.poses, sequence.posed)
    if sequence is not None and not model.same_unit(sequence):
        units = f"{sequence.unit}, and the model's in {model.configuration['unit']}"
        report_line(f"{sequence.name}: its poses are in {units}: they are not compared", bold=True)
        truth, posed = None, None
    odometry, pictures = odometry_of(model), Thumbnails()
    started, number, stopped = time.perf_counter(), 0, ""
    with ResultsWriter(out, answer=odometry.answer) as writer:
        with StreamRunner(odometry, writer, truth=truth, posed=posed) as runner:
            try:
                with closing(prefetch(stream)) as frames:
                    for number, frame in enumerate(frames, start=1):
                        estimate = runner.push(frame)
                        if estimate is not None:
                            for sink in sinks:
                                sink(frame, estimate, runner.scores.true_pose(frame))
                            report("frames", number, stream.n_frames or 0)
                        if estimate is not None and estimate.region is not None and frame.image is not None:
                            pictures.add(frame.name, frame.image)
                        if stop.signals or number == stop.limit:
                            break
            except SourceError as exc:
                stopped = str(exc)
            stopped = INTERRUPTED if stop.signals and not stopped else stopped
            runner.finish()
        if not runner.n_answered:
            first = next(iter(runner.problems.values()), "it holds no frame")
            raise OdometryError(f"{stream.name}: no frame could be answered: {stopped or first}")
        if (truth := runner.scores.truth) is not None:
            writer.truth(truth)
    whole = not (stopped or number == stop.limit or stream.live or runner.windowed)
    seconds, paths = round(time.perf_counter() - started, 2), dict(runner.trajectories)
    return Answers(model, part, runner, writer, paths, pictures.jpegs, stopped, whole, seconds)


def metrics_of(answers: Answers) -> dict[str, Any]:
    """The content of ``metrics.json``."""
    model, runner, part, split = answers.model, answers.runner, answers.part, answers.model.split
    note, every = "all frames of the source (training frames among them, if the source is the training data).", False
    if part is not Part.ALL:
        n_part = len(split.test)
        every = runner.n_answered == n_part
        some = "" if every else f"{runner.n_answered} of {counted(n_part, 'frame')} of "
        note = f"{some}the test part of split {split.kind}, seed {split.seed}."
    motion, sizes, n_unknown, n_unreliable = Counter[str](), list[list[float]](), 0, 0
    for one in answers.writer.records():
        motion[one["motion"]] += 1
        n_unreliable += not one["reliable"]
        n_unknown += one["evidence"] == EvidenceType.UNKNOWN.name.lower()
        if record_bounded(one):
            sizes.append(record_size(one))
    metrics: dict[str, Any] = {
        "command": "run",
        "provenance": provenance(),
        "configuration": {**model.settings, "part": str(part)},
        "seed": split.seed,
        "sign_reference_quat_wxyz": model.sign_reference.tolist(),
        "split": str(split.kind),
        "split_note": note,
        "n_answered": runner.n_answered,
        "results": answers.writer.digests,
        "n_unreliable": n_unreliable,
        "n_localized": runner.n_localized,
        "n_unknown": n_unknown,
        "n_unbounded": runner.n_answered - len(sizes) - n_unknown,
        "guarantee": short_guarantee(model),
        "median_length": None if not sizes else np.median(sizes, axis=0).tolist(),
        "n_without_image": runner.n_problems,
        "problems": runner.problems,
        "motion": {kind: n for kind, n in sorted(motion.items()) if kind != "first"},
        "stopped": answers.stopped,
        "seconds": answers.seconds,
    }
    if model.journal:
        metrics["journal"] = [asdict(entry) for entry in model.journal]
    truth, paths = runner.scores.truth, answers.trajectories
    rows = None if truth is None else np.array(runner.scores.rows_with_truth)
    if truth is not None and rows is not None:
        paths = {name: path[rows] for name, path in paths.items()}
        metrics |= {"n_with_truth": len(truth), "errors": error_table(paths, truth)}
        exchangeable = answers.whole and every and model.frames_are_exchangeable
        metrics["coverage"] = coverage_table(runner.scores.statistics, model, exchangeable=exchangeable)
        metrics["path_coverage"] = runner.path_coverage
    return metrics | {"verdict": _verdict(metrics)}


def _verdict(metrics: dict[str, Any]) -> list[str]:
    """What holds, how large regions are, and what to do, one line each."""
    n, n_unknown, size = (metrics[name] for name in ("n_answered", "n_unknown", "median_length"))
    unit, coverage = metrics["configuration"]["unit"], metrics.get("coverage")
    holds = "no true poses here; conformodal evaluate OUT --truth FILE counts them"
    if coverage is not None:
        holds = f"{describe_coverage(coverage)}{_explain(coverage)}"
    sides = " x ".join(f"{side:.3g}" for side in size or [])
    extent = f"regions are {sides} {unit} (x, y, z; median)" if sides else "no region is bounded"
    if "errors" in metrics:
        extent += f"; median error of the position {length(next(iter(metrics['errors'].values()))['median_m'], unit)}"
    step = f"use the {n - metrics['n_unreliable']} of {counted(n, 'pose')} marked reliable"
    if metrics["stopped"]:
        step = f"run again, or use what there is: stopped early, {metrics['stopped']}"
    elif n_unknown > n / 2:
        step = f"record these places and train again: {n_unknown} of {counted(n, 'frame')} show no known place"
    elif metrics["n_unbounded"] > n / 2:
        step = "calibrate with more recordings, or ask for a larger --alpha: most regions are unbounded"
    return [f"coverage: {holds} ({metrics['guarantee']})", f"size: {extent}", f"next: {step}"]


def _explain(coverage: dict[str, Any]) -> str:
    """Why regions hold fewer poses than were asked for."""
    asked, share = 1 - float(coverage["alpha"]), coverage["bounded_coverage"]
    if share is None or share >= asked:
        return ""
    if coverage["joint"] == "none":
        return ", fewer than each number of the pose alone, as is to be expected of seven"
    if (band := coverage["joint_band_99"]) is None:
        return f", fewer than the {asked:g} asked for: see in brackets what is guaranteed"
    within = "as" if band[0] <= coverage["joint_coverage"] else "fewer than"
    return f", {within} chance allows ({band[0]:.3f} to {band[1]:.3f} over all frames, 99 % band)"


def write_answers(
    answers: Answers, metrics: dict[str, Any], title: str, summary: list[str], walls: Sequence[FloatArray] = ()
) -> None:
    """Write the page, and publish it with the metrics and all that was written of the run."""
    runner = answers.runner
    level, unit, paths = answers.model.rules.level, metrics["configuration"]["unit"], answers.trajectories
    trained_xyz = answers.model.known_frames.poses[answers.model.localizer.frames, :3]
    around = Surroundings(walls, unit, trained_xyz)
    try:
        records, truth = answers.writer.records(), runner.scores.truth
        viewer = make_viewer(records, paths, truth, answers.pictures, level, around)
        write_page(answers.writer.unfinished(PAGE), title, summary, metrics, viewer)
    finally:  # a page that cannot be made takes no results with it
        answers.writer.publish(metrics)


def describe_outcome(name: str, metrics: dict[str, Any]) -> list[str]:
    """What was answered, in more detail than the verdict."""
    n, n_unknown = counted(metrics["n_answered"], "frame"), metrics["n_unknown"]
    lines = [
        f"{name}: {n} answered, {metrics['split_note']}",
        f"Frames not reliable (motion or place): {metrics['n_unreliable']}; without a usable image or time: "
        f"{metrics['n_without_image']}; with a pose from landmarks: {metrics['n_localized']}.",
    ]
    if n_unknown:
        lines.append(f"{n_unknown} of {n} {noun_for(n_unknown, 'shows', 'show')} no known place: unbounded there.")
    return lines


def report_outcome(name: str, metrics: dict[str, Any]) -> None:
    """The result on the terminal."""
    if "errors" in metrics and metrics["n_with_truth"] < metrics["n_answered"]:
        report_line(f"{metrics['n_with_truth']} of {metrics['n_answered']} frames have a true pose; of these:")
    for line in metrics["verdict"]:
        report_line(line)
    report_detail = partial(report_line, detail=True)
    for line in describe_outcome(name, metrics):
        report_detail(line)
    for frame, problem in list(metrics["problems"].items())[:3]:
        report_line(f"  {frame}: {problem}")
    if "errors" not in metrics:
        return
    print_errors(metrics["errors"], metrics["split_note"], metrics["configuration"]["unit"], detail=True)
    report_detail(metrics["coverage"]["assumption"])


def print_errors(errors: dict[str, dict[str, float]], note: str, unit: str, *, detail: bool = False) -> None:
    """The table of errors by method."""
    shown = ("rmse_m", "rmse_deg", "median_m", "median_deg", "rpe_rmse_m", "rpe_rmse_deg")
    columns = [name for name in shown if name in next(iter(errors.values()))]
    headings = [f"{column.removesuffix('_m')}_{unit}" if column.endswith("_m") else column for column in columns]
    width = max(map(len, METHOD_LABELS.values()))
    report_line(f"errors, {note}", detail=detail)
    report_line(" │ ".join([f"{'method':<{width}}", *(f"{heading:>8}" for heading in headings)]), detail=detail)
    for name, row in errors.items():
        values = [f"{row[column]:>{max(8, len(head))}.4f}" for column, head in zip(columns, headings, strict=True)]
        report_line(" │ ".join([f"{METHOD_LABELS.get(name, name):<{width}}", *values]), detail=detail)


def describe_coverage(coverage: dict[str, Any]) -> str:
    """How often bounded regions contain the true pose, and the share of regions that are unbounded in some target."""
    if coverage["joint_coverage"] is None:
        return "whether regions contain the true pose is not known: the truth has no orientations"
    n, n_bounded = coverage["n_evaluated"], coverage["n_bounded"]
    open_ended = f"{n - n_bounded} of {counted(n, 'region')} unbounded in some target"
    if not n_bounded:
        return f"{open_ended}, which says nothing of coverage"
    held, share = round(coverage["bounded_coverage"] * n_bounded), 100 * coverage["bounded_coverage"]
    verb = noun_for(held, "contains", "contain")
    text = f"{held} of {counted(n_bounded, 'bounded region')} ({share:.1f} %) {verb} the true pose; {open_ended}"
    if (rooms := coverage.get("by_room")) and rooms[0]["bounded_coverage"] is not None:
        text += f"; {100 * rooms[0]['bounded_coverage']:.1f} % in the least covered of {len(rooms)} rooms"
    return text
