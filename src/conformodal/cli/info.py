"""``conformodal info``: what a saved model knows and guarantees."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from conformodal.pipeline.guarantee import describe_guarantee, guarantees, short_guarantee
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import METRICS, read_metrics
from conformodal.pipeline.store import load_model, model_digest
from conformodal.pipeline.whole_recordings import describe_units

from .console import AsJson, Verbose, print_json, report_line
from .sources import SavedModel


def info(model: SavedModel, verbose: Verbose = False, as_json: AsJson = False) -> None:
    """Print what a saved model's regions hold, how large they are, and what to do next."""
    facts = _facts(load_model(model), model)
    print_json(facts)
    for line in (*facts["verdict"], *facts.get("journal", ())):
        report_line(line)
    for name, value in facts.items():
        report_line(f"{name}: {'; '.join(value) if name in ('guarantees', 'journal') else value}", detail=True)


def _facts(model: PoseModel, folder: Path) -> dict[str, Any]:
    """What is printed, by name."""
    by_type = guarantees(model)
    digest, trained = model_digest(folder), read_metrics(folder) if (folder / METRICS).exists() else {}
    if trained.get("model") != digest:  # of a training before, where the last one was killed in its last moment
        trained = {}
    return {
        "model": digest,
        "configuration": model.settings,
        "frames": {part: len(model.split.part(part)) for part in ("train", "calibration", "test")},
        "camera": asdict(model.camera),
        "bounded_regions": {one.evidence.name.lower(): one.finite for one in by_type},
        "verdict": trained.get("verdict") or [f"coverage: {short_guarantee(model)}"],
        "guarantee": describe_guarantee(model),
        "guarantees": [one.describe() for one in by_type],
        **_growth(model),
        "bytes": {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.is_file()},
    }


def _growth(model: PoseModel) -> dict[str, Any]:
    """The recordings that joined a model later, and what calibrates it; nothing of a model as it was trained."""
    if not model.journal:
        return {}
    return {"journal": [entry.describe() for entry in model.journal], "units": describe_units(model)}
