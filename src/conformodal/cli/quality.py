"""Whether a recording is good enough: what ``data check`` and ``train`` say of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from conformodal.core.arrays import IntArray
from conformodal.core.progress import StageProgress
from conformodal.datasets import DatasetCheck, Sequence
from conformodal.localization.evidence import FrameEvidence
from conformodal.model.config import Method, ModelConfig
from conformodal.model.model import PoseModel
from conformodal.quality.advice import describe_quality, names_of, quality_record, record_next
from conformodal.quality.examining import RecordingQuality, examine
from conformodal.running.results.runs import write_metrics
from conformodal.training.training_data import TrainingData
from conformodal.vision.features import FeatureCache

from .console import console, report_strongly

PAGE, FIGURES = "report.html", "figures"
_IN_TRAINING = 3  # sentences of advice


def judge(sequence: Sequence, model: PoseModel | None, cache: Path, report: StageProgress) -> RecordingQuality | None:
    """Examine a recording; None where there is nothing to go by, neither poses nor a model."""
    if model is not None:
        return examine(sequence, model, cache=FeatureCache(cache), progress=report)
    found = examine(sequence)
    return None if found.poses is None else found


def report_quality(found: RecordingQuality, sequence: Sequence) -> None:
    """The findings, and what to record or train on next."""
    for line in describe_quality(found):
        console.print(line, soft_wrap=True)
    advice = record_next(found, names_of(found, sequence))
    if advice:
        report_strongly("what to record or train on next, the most valuable first:")
    for number, line in enumerate(advice, start=1):
        console.print(f"  {number}. {line}", soft_wrap=True)


def require_figures() -> None:
    """Refuse to begin where what draws the page is not installed."""
    import conformodal.report.quality  # noqa: F401, PLC0415 - what draws takes time to import


def write_findings(
    out: Path, found: RecordingQuality | None, sequence: Sequence, check: DatasetCheck, record: dict[str, Any]
) -> None:
    """Write ``metrics.json``, and then the page, or none where there is nothing to show."""
    from conformodal.report.quality import PLAN, write_quality_page  # noqa: PLC0415 - what draws takes time to import

    if found is None:
        write_metrics(out, record)
        (out / PAGE).unlink(missing_ok=True)  # of an earlier check
        (out / FIGURES / PLAN).unlink(missing_ok=True)
        return
    whole = {**record, "quality": quality_record(found, sequence)}
    write_metrics(out, whole)
    findings = [
        f"{'' if finding.wrong else 'note: '}{finding.count} x {finding.what}: {finding.first}"
        for finding in check.findings
    ]
    write_quality_page(out, found, sequence, whole, findings)


def quality_of_training(data: TrainingData, model: PoseModel, config: ModelConfig) -> RecordingQuality | None:
    """Of the recording that a model was just trained on; None for the paper's system, which has no more to say."""
    if config.method is Method.PAPER:
        return None
    local_features = data.for_sources(config).local_features

    def look(frames: IntArray) -> tuple[IntArray, FrameEvidence]:
        local = local_features(frames) if model.looks_at_local_features else ()
        return frames, FrameEvidence(data.features[frames], local)

    return examine(data.sequence, model, just_trained=look)


def report_briefly(found: RecordingQuality, sequence: Sequence) -> None:
    """What ``train`` says of it."""
    for line in describe_quality(found):
        console.print(line, soft_wrap=True)
    for line in record_next(found, names_of(found, sequence))[:_IN_TRAINING]:
        console.print(line, soft_wrap=True)
