"""``conformodal info``: what a saved model knows, guarantees and costs."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from conformodal.features.backbone import OnnxBackbone
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.config import Runtime
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.store import load_model, model_digest

from .console import report_errors, report_line
from .sources import SavedModel

_TIMED = 20


@report_errors
def info(
    model: SavedModel, as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False
) -> None:
    """Print a saved model's training data, guarantee, size and network speed."""
    found = _facts(load_model(model), model)
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    for line in describe_facts(found):
        report_line(line)


def _facts(model: PoseModel, folder: Path) -> dict[str, Any]:
    """The facts that :func:`info` prints, for JSON."""
    rules, split, camera = model.rules, model.split, model.camera
    kinds = np.array([kind.value for kind in EvidenceType])
    reached = np.atleast_1d(np.isfinite(rules.thresholds(kinds)).all(axis=1)).tolist()
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
        "recognised_level": model.recognised_level,
        "bounded_regions": {kind.name.lower(): one for kind, one in zip(EvidenceType, reached, strict=True)},
        "radius_m": None if model.radius is None else model.radius.radius_m,
        "bytes": {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.is_file()},
        "network": model.backbone.config.name,
        "runtime": _runtime(model),
        "network_ms": _milliseconds(model),
    }


def describe_facts(found: dict[str, Any]) -> list[str]:
    """The facts as lines."""
    parts = ", ".join(f"{n} for {part}" for part, n in found["frames"].items())
    what = "the whole pose" if found["joint"] != "none" else "each target by itself"
    units = "frames" if found["calibrated_on"] == "frames" else "frames, in whole stretches or recordings,"
    unbounded = [kind for kind, bounded in found["bounded_regions"].items() if not bounded and kind != "unknown"]
    radius = f"{found['radius_m']:.3f} m" if found["radius_m"] is not None else "none (conformodal calibrate gives one)"
    return [
        f"trained on {found['data']}: frames {parts} (split {found['split']}, seed {found['seed']})",
        f"camera: {found['camera']['width']}x{found['camera']['height']}, fx {found['camera']['fx']:.1f}, "
        f"fy {found['camera']['fy']:.1f}",
        f"method {found['method']}; sources: {', '.join(found['sources'])}",
        f"guarantee: regions hold {what} with probability at least {1 - found['alpha']:g}, for frames exchangeable "
        f"with the {found['n_calibration']} {units} that calibrated them",
        *(f"evidence {kind}: too few calibration frames, the region is unbounded" for kind in unbounded),
        f"images whose p-value of showing a known place is at most {found['novelty_level']:g} "
        f"({found['recognised_level']:g} where a place is recognised) get an unbounded region",
        f"radius around the chosen pose: {radius}",
        f"size: {sum(found['bytes'].values()) / 1e6:.1f} MB",
        f"network {found['network']} in {found['runtime']}: {found['network_ms']:.1f} ms per image here",
    ]


def _runtime(model: PoseModel) -> str:
    """What runs the network; a model trained in torch may have been exported since."""
    if not isinstance(model.backbone, OnnxBackbone):
        return str(Runtime.TORCH)
    eight_bits = model.configuration.get("runtime") == Runtime.INT8
    return str(Runtime.INT8 if eight_bits else Runtime.ONNX)


def _milliseconds(model: PoseModel) -> float:
    """Median time of the network for one image."""
    config = model.backbone.config
    image = np.random.default_rng(0).integers(0, 256, (1, config.height, config.width, 3), dtype=np.uint8)
    times = []
    for _ in range(_TIMED):
        started = time.perf_counter()
        model.backbone.maps(image)
        times.append(1e3 * (time.perf_counter() - started))
    return round(float(np.median(times)), 2)
