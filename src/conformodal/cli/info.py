"""``conformodal info``: what a saved model knows and guarantees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from conformodal.pipeline.guarantee import describe_guarantee, guarantees, short_guarantee
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.results import METRICS, read_metrics
from conformodal.pipeline.store import load_model, model_digest

from .console import AsJson, Verbose, print_json, report_line
from .sources import SavedModel


def info(model: SavedModel, verbose: Verbose = False, as_json: AsJson = False) -> None:
    """Print what a saved model's regions hold, how large they are, and what to do next."""
    facts = _facts(load_model(model), model)
    print_json(facts)
    for line in facts["verdict"]:
        report_line(line)
    for line in describe_facts(facts):
        report_line(line, detail=True)


def _facts(model: PoseModel, folder: Path) -> dict[str, Any]:
    """The facts that :func:`info` prints, for JSON."""
    rules, split, camera = model.rules, model.split, model.camera
    by_type = guarantees(model)
    trained = read_metrics(folder) if (folder / METRICS).exists() else {}
    return {
        "model": model_digest(folder),
        "method": str(model.method),
        "data": model.configuration.get("data"),
        "frames": {part: len(split.part(part)) for part in ("train", "calibration", "test")},
        "split": str(split.kind),
        "seed": split.seed,
        "camera": {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy},
        "sources": [source.name for source in model.localizer.sources],
        "alpha": model.alpha,
        "joint": rules.overall.joint,
        "calibrated_on": model.configuration.get("calibrate_on"),
        "n_calibration": model.n_calibration,
        "novelty_level": rules.level,
        "bounded_regions": {one.evidence.name.lower(): one.finite for one in by_type},
        "verdict": trained.get("verdict") or [f"coverage: {short_guarantee(model)}"],
        "guarantee": describe_guarantee(model),
        "guarantees": [one.describe() for one in by_type],
        "bytes": {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.is_file()},
        "network": model.backbone.config.name,
    }


def describe_facts(facts: dict[str, Any]) -> list[str]:
    """The facts as lines."""
    camera, parts = facts["camera"], ", ".join(f"{n} for {part}" for part, n in facts["frames"].items())
    return [
        f"trained on {facts['data']}: frames {parts} (split {facts['split']}, seed {facts['seed']})",
        f"camera: {camera['width']}x{camera['height']}, fx {camera['fx']:.1f}, fy {camera['fy']:.1f}",
        f"method {facts['method']}; sources: {', '.join(facts['sources'])}",
        facts["guarantee"],
        *facts["guarantees"],
        f"images without a recognised place get an unbounded region if their p-value of showing a known one is at most "
        f"{facts['novelty_level']:g}",
        f"size: {sum(facts['bytes'].values()) / 1e6:.1f} MB; network {facts['network']}",
    ]
