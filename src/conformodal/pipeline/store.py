"""Saved models: arrays in safetensors, the network in ONNX, everything else in JSON; no pickle and no code.

``model.json`` names the other files with their digests, and has one of itself. They detect damaged or altered files;
they are not a signature, so they do not prove who saved a model.
"""

from __future__ import annotations

import hashlib
import json
import math
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal.conformal import ConformodalError, NoveltyTest, QuantileBins, SplitConformal
from conformodal.core.arrays import AnyArray
from conformodal.core.extras import MissingPackageError
from conformodal.core.files import read_file, write_whole
from conformodal.core.words import finite_or_none
from conformodal.features.backbone import Backbone, BackboneConfig
from conformodal.features.local import QualityRange
from conformodal.geometry import PinholeCamera
from conformodal.io import Split
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import MotionPrior
from conformodal.localizer.radius import PoseRadius
from conformodal.localizer.regions import PlaceNovelty, RegionRules
from conformodal.localizer.sources.registry import SourceState, find_source

from .expected_input import ExpectedInput
from .identity import FrameIdentities
from .model import PATHS, PoseModel, SourceComparison, path_rule

FORMAT = "conformodal-model-21"
_JSON = "model.json"
_FILES = {"weights": "weights-{}.safetensors", "network": "network-{}.onnx"}  # with the first digits of their digests
# what reading damaged files raises: ValueError is every error of this package too, RuntimeError JSON without end
_DAMAGE = (SafetensorError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RuntimeError)
_PARTS = ("train", "calibration", "test")
# Arrays by name: kind of their numbers, and dimensions. A star stands for a number or a path; pose sources check their
# own.
_ARRAYS = {
    "bins.*": ("f", 1), "cells.*": ("f", 1), "split.*": ("i", 1), "sign_reference": ("f", 1),
    "frames.files": ("u", 2), "frames.poses": ("f", 2),
    "calibration.scores": ("f", 2), "calibration.known_p": ("f", 1), "calibration.recognised": ("b", 1),
    "calibration.units": ("i", 1), "calibration.loc": ("f", 1), "calibration.scale": ("f", 1),
    "path.*.scores": ("f", 1), "path.*.units": ("i", 1), "path.*.sizes": ("i", 1),
    "novelty.references": ("f", 2), "novelty.units": ("i", 1),
    "matched.scores": ("f", 1), "matched.units": ("i", 1), "disturbed.novelty": ("f", 1), "disturbed.units": ("i", 1),
    "disturbed.scores": ("f", 2), "disturbed.known_p": ("f", 1), "quality": ("f", 2),
    "colours": ("f", 1),
}  # fmt: skip


class ModelFileError(ConformodalError):
    """A saved model that is missing, incomplete, of another version, or not as it was saved; names the file."""


def save_model(model: PoseModel, folder: Path) -> None:
    """Write a model into a folder, created if missing; an earlier model stays complete until the new one is."""
    states = {source.name: source.state() for source in model.localizer.sources}
    arrays = {f"source.{name}.{k}": v for name, state in states.items() for k, v in state.arrays.items()}
    arrays |= {k: v for k, v in _arrays(model).items() if v is not None}
    weights = save_tensors({k: np.ascontiguousarray(v) for k, v in arrays.items()})
    contents = {"weights": weights, "network": model.backbone.content}
    record: dict[str, Any] = {
        "format": FORMAT,
        "backbone": asdict(model.backbone.config),
        "backbone_fingerprint": model.backbone.fingerprint,
        "sources": [{"name": name, "settings": state.settings} for name, state in states.items()],
        "calibration": {
            "alpha": model.alpha,
            "score": model.calibration.score_.name,
            "joint": model.calibration.joint,
            "novelty_level": model.rules.level,
        },
        "prior": _finite(asdict(model.prior)),
        "camera": asdict(model.camera),
        "split": {"kind": str(model.split.kind), "seed": model.split.seed},
        "step_s": model.expected_input.step_s,
        "configuration": model.configuration,
        "radius": None if model.radius is None else _finite(asdict(model.radius)),
        "comparison": None if model.comparison is None else asdict(model.comparison),
        **{name: hashlib.sha256(contents[name]).hexdigest() for name in _FILES},
    }
    record["sha256"] = _digest(record)
    for name, content in contents.items():
        write_whole(_path(folder, name, record[name]), content)
    write_whole(folder / _JSON, json.dumps(record, indent=1) + "\n")
    for name, pattern in _FILES.items():  # of an earlier model
        for path in folder.glob(pattern.format("*")):
            if path != _path(folder, name, record[name]):
                path.unlink(missing_ok=True)


def _path(folder: Path, name: str, digest: str) -> Path:
    return folder / _FILES[name].format(digest[:8])


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    """The record with null for infinity and NaN, which JSON does not have."""
    return {k: finite_or_none(v) if isinstance(v, float) else v for k, v in record.items()}


def _digest(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _arrays(model: PoseModel) -> dict[str, AnyArray | None]:
    """All arrays of a model but those of its sources; None for what it does not have."""
    rules, overall, novelty = model.rules, model.calibration, model.novelty
    loc, scale = overall.scales() if overall.joint == "max" else (None, None)
    arrays: dict[str, AnyArray | None] = {
        **{f"bins.{j}": edges for j, edges in enumerate(model.bins.edges_)},
        **{f"cells.{j}": edges for j, edges in enumerate(overall.bins.edges_)},
        **{f"split.{part}": model.split.part(part) for part in _PARTS},
        "sign_reference": model.sign_reference,
        "frames.files": model.known_frames.files,
        "frames.poses": model.known_frames.poses,
        "colours": model.expected_input.colours,
        "calibration.scores": overall.scores_,
        "calibration.known_p": rules.known_p,
        "calibration.recognised": rules.recognised,
        "calibration.units": overall.units_,
        "calibration.loc": loc,
        "calibration.scale": scale,
    }
    for path, rule in model.path_rules.items():
        arrays[f"path.{path}.scores"] = rule.scores_.max(axis=1)
        arrays |= {f"path.{path}.units": rule.units_, f"path.{path}.sizes": rule.unit_sizes_}
    if novelty is not None:
        arrays |= {"novelty.references": novelty.test.references, "novelty.units": novelty.test.units_}
        if novelty.matched is not None:
            arrays |= {"matched.scores": novelty.matched.scores_, "matched.units": novelty.matched.units_}
        if novelty.disturbed is not None and rules.disturbed is not None and model.quality is not None:
            arrays |= {"disturbed.novelty": novelty.disturbed.scores_, "disturbed.units": novelty.disturbed.units_}
            arrays |= {"disturbed.scores": rules.disturbed.scores_, "disturbed.known_p": rules.disturbed_p}
            arrays["quality"] = np.stack((model.quality.low, model.quality.high))
    return arrays


def load_model(folder: Path | str) -> PoseModel:
    """Read a model back.

    Raises
    ------
    ModelFileError
        If a file is missing, damaged or altered, or was made for another version or backbone.
    """
    folder = Path(folder)
    try:
        record = _read_record(folder / _JSON)
        arrays = load_tensors(_read(folder, "weights", record))
        _check_arrays(arrays)
        return _assemble(record, arrays, folder)
    except (ModelFileError, MissingPackageError):
        raise
    except _DAMAGE as exc:
        raise ModelFileError(f"{folder}: is not a complete {FORMAT}: {type(exc).__name__}: {exc}") from exc


def model_digest(folder: Path) -> str | None:
    """Digest of the trained model in a folder, without its radius; None without a model."""
    try:
        return str(_read_record(folder / _JSON)["weights"])
    except (ModelFileError, KeyError):
        return None


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(read_file(path))
    except OSError as exc:
        raise ModelFileError(f"{path}: no saved model there: {exc.strerror}") from exc
    except (ValueError, RecursionError) as exc:
        raise ModelFileError(f"{path}: is not JSON: {exc}") from exc
    stated = record.get("format") if isinstance(record, dict) else type(record).__name__
    if stated != FORMAT:
        raise ModelFileError(f"{path}: holds format {stated!r}, expected {FORMAT!r}. Train the model again")
    if record.pop("sha256", None) != _digest(record):
        raise ModelFileError(f"{path}: was altered since it was saved: its digest differs")
    return dict(record)


def _read(folder: Path, name: str, record: dict[str, Any]) -> bytes:
    """The content of one of the files that a record names."""
    path = _path(folder, name, record[name])
    try:
        content = read_file(path)
    except OSError as exc:
        raise ModelFileError(f"{path}: cannot be read: {exc.strerror}") from exc
    if hashlib.sha256(content).hexdigest() != record[name]:
        raise ModelFileError(f"{path}: is not the file that was saved with {_JSON}: its digest differs")
    return content


def _check_arrays(arrays: dict[str, AnyArray]) -> None:
    """Refuse arrays that a model does not have, and others than it has."""
    for name, array in arrays.items():
        group, *rest = name.split(".")
        expected = _ARRAYS.get(name) or _ARRAYS.get(".".join([group, "*", *rest[1:]]))
        if group != "source" and expected != (array.dtype.kind, array.ndim):
            raise TypeError(f"array {name} is {array.dtype} {array.shape}, expected {expected}")


def _assemble(record: dict[str, Any], arrays: dict[str, AnyArray], folder: Path) -> PoseModel:
    if record["network"] is None:
        raise ModelFileError(f"{folder}: holds no network in ONNX. Train the model again")
    backbone, stated, split, radius = (record[name] for name in ("backbone", "calibration", "split", "radius"))
    config = BackboneConfig(**{**backbone, "grid": tuple(backbone["grid"])})
    edges = {
        kind: [arrays[f"{kind}.{j}"] for j in range(sum(name.startswith(f"{kind}.") for name in arrays))]
        for kind in ("bins", "cells")
    }
    sources = []
    for source in record["sources"]:
        start = f"source.{source['name']}."
        mine = {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}
        sources.append(find_source(source["name"]).from_state(SourceState(mine, source["settings"])))
    novelty = _novelty(arrays, config.grid)
    rules = _rules(QuantileBins.from_edges(edges["cells"]), stated, arrays, novelty)
    if radius is not None and radius["radius_rad"] is None:
        radius["radius_rad"] = math.inf
    prior: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record["prior"].items()}
    prior |= {k: math.nan for k in ("depth_m", "depth_spread") if prior[k] is None}
    return PoseModel(
        backbone=Backbone(config, _read(folder, "network", record)),
        localizer=Localizer(tuple(sources), QuantileBins.from_edges(edges["bins"]), arrays["sign_reference"]),
        novelty=novelty,
        rules=rules,
        prior=MotionPrior(**prior),
        camera=PinholeCamera(**record["camera"]),
        split=Split(split["kind"], split["seed"], **{part: arrays[f"split.{part}"] for part in _PARTS}),
        known_frames=FrameIdentities(arrays["frames.files"], arrays["frames.poses"]),
        expected_input=ExpectedInput(float(record["step_s"]), arrays["colours"]),
        configuration=record["configuration"],
        radius=None if radius is None else PoseRadius(**radius),
        comparison=None if record["comparison"] is None else SourceComparison(**record["comparison"]),
        path_rules={path: _path_rule(rules, arrays, path) for path in PATHS if f"path.{path}.scores" in arrays},
        quality=QualityRange(*arrays["quality"]) if "quality" in arrays else None,
    )


def _rules(
    cells: QuantileBins, stated: dict[str, Any], arrays: dict[str, AnyArray], novelty: PlaceNovelty | None
) -> RegionRules:
    overall = SplitConformal(cells, float(stated["alpha"]), stated["score"], stated["joint"])
    if overall.joint == "max":
        overall.set_scale(arrays["calibration.scale"], arrays["calibration.loc"])
    overall.calibrate_scores(arrays["calibration.scores"], arrays.get("calibration.units"))
    known_p, recognised = arrays["calibration.known_p"], arrays.get("calibration.recognised")
    rules = RegionRules(overall, recognised, known_p, float(stated["novelty_level"]))
    if novelty is None or novelty.disturbed is None:
        return rules
    units = None if overall.units_ is None else novelty.disturbed.units_
    disturbed = copy(overall).calibrate_scores(arrays["disturbed.scores"], units)
    return replace(rules, disturbed=disturbed, disturbed_p=arrays["disturbed.known_p"])


def _path_rule(rules: RegionRules, arrays: dict[str, AnyArray], path: str) -> SplitConformal:
    rule = path_rule(rules.overall.bins, rules.overall.alpha)
    scores = np.repeat(arrays[f"path.{path}.scores"][:, None], rule.bins.n_targets, axis=1)
    return rule.calibrate_scores(scores, *(arrays.get(f"path.{path}.{name}") for name in ("units", "sizes")))


def _novelty(arrays: dict[str, AnyArray], grid: tuple[int, int]) -> PlaceNovelty | None:
    if "novelty.references" not in arrays:
        return None
    test = NoveltyTest(arrays["novelty.references"], arrays["novelty.units"])
    matched = disturbed = None
    if "matched.scores" in arrays:
        matched = test.rescored(arrays["matched.scores"], arrays["matched.units"])
    if "disturbed.novelty" in arrays:
        disturbed = test.rescored(arrays["disturbed.novelty"], arrays["disturbed.units"])
    return PlaceNovelty(test, grid, matched, disturbed)
