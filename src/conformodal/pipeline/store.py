"""Saved models: arrays in safetensors, the network in ONNX, everything else in JSON; no pickle and no code.

``model.json`` contains digests of the other files and of itself. They detect damaged or altered files; they are not a
signature, so they do not prove who saved a model.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal.conformal import NoveltyTest, QuantileBins, SplitConformal
from conformodal.core.arrays import AnyArray
from conformodal.core.extras import MissingPackageError, require_extra
from conformodal.core.files import write_whole
from conformodal.core.words import finite_or_none
from conformodal.features.backbone import Backbone, BackboneConfig, OnnxBackbone
from conformodal.features.image_quality import QualityRange
from conformodal.geometry import PinholeCamera
from conformodal.io import Split
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.novelty import PlaceNovelty
from conformodal.localizer.prior import MotionPrior
from conformodal.localizer.radius import PoseRadius
from conformodal.localizer.region_rules import RegionRules
from conformodal.localizer.sources.registry import PoseSource, SourceState, find_source

from .comparison import SourceComparison
from .errors import ModelFileError
from .identity import FrameIdentities
from .model import PATHS, PoseModel, path_rule

_FORMAT = "conformodal-model-19"
_JSON, _WEIGHTS, _NEXT = "model.json", "weights.safetensors", "weights.safetensors.next"
_NETWORKS = "network-*.onnx"
_ATTEMPTS = 2
_DAMAGE = (
    SafetensorError,
    AttributeError,
    IndexError,
    KeyError,
    TypeError,
    ValueError,  # and every error of this package
    ArithmeticError,
    RuntimeError,  # torch, and JSON nested without end
)
_PARTS = ("train", "calibration", "test")
_IDENTITIES = ("files", "pixels", "poses")
_PRIOR_TABLES = ("intervals_s", "top_speed_mps", "acceleration_density")
_PRIOR_DEPTHS = ("depth_m", "depth_spread")


def save_model(model: PoseModel, folder: Path) -> None:
    """Write a model into a folder, created if missing; an earlier model stays complete until the new one is."""
    rules, localizer = model.rules, model.localizer
    states = {source.name: source.state() for source in localizer.sources}
    arrays: dict[str, AnyArray] = {
        f"source.{name}.{k}": v for name, state in states.items() for k, v in state.arrays.items()
    }
    network = model.backbone.content if isinstance(model.backbone, OnnxBackbone) else None
    arrays |= {f"bins.{j}": e for j, e in enumerate(localizer.bins.edges_)}
    arrays |= {f"cells.{j}": e for j, e in enumerate(rules.overall.bins.edges_)}
    arrays |= {f"split.{part}": model.split.part(part) for part in _PARTS}
    arrays |= {f"known.{k}": getattr(model.known_frames, k) for k in _IDENTITIES}
    arrays |= _calibration_arrays(model) | _novelty_arrays(model)
    arrays["sign_reference"] = localizer.sign_reference
    weights = save_tensors({k: np.ascontiguousarray(v) for k, v in arrays.items()})
    record: dict[str, Any] = {
        "format": _FORMAT,
        "backbone": asdict(model.backbone.config),
        "backbone_fingerprint": model.backbone.fingerprint,
        "sources": [{"name": name, "settings": state.settings} for name, state in states.items()],
        "calibration": {
            "alpha": model.alpha,
            "score": rules.overall.score_.name,
            "joint": rules.overall.joint,
            "novelty_level": rules.level,
            "reliable_p": model.reliable_p,
        },
        "prior": _finite(asdict(model.prior)),
        "camera": asdict(model.camera),
        "split": {"kind": str(model.split.kind), "seed": model.split.seed},
        "configuration": model.configuration,
        "radius": None if model.radius is None else _finite(asdict(model.radius)),
        "comparison": None if model.comparison is None else asdict(model.comparison),
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
        "network": None,
    }
    if network is not None:
        record["network"] = {"sha256": hashlib.sha256(network).hexdigest()}
    record["sha256"] = _digest(record)
    # complete at any time: the old files stay until the new record is written
    if network is not None:
        write_whole(folder / _network_file(record), network)
    write_whole(folder / _NEXT, weights)
    write_whole(folder / _JSON, json.dumps(record, indent=1) + "\n")
    (folder / _NEXT).replace(folder / _WEIGHTS)
    for other in folder.glob(_NETWORKS):
        if network is None or other.name != _network_file(record):
            other.unlink(missing_ok=True)


def _calibration_arrays(model: PoseModel) -> dict[str, AnyArray]:
    rules = model.rules
    arrays: dict[str, AnyArray] = {
        "calibration.overall": rules.overall.scores_,
        "calibration.known_p": rules.known_p,
    }
    if rules.recognised is not None:
        arrays["calibration.recognised"] = rules.recognised
    if rules.overall.units_ is not None:
        arrays["calibration.groups"] = rules.overall.units_
    for path, rule in model.path_rules.items():
        arrays[f"calibration.{path}"] = rule.scores_.max(axis=1)
        if rule.units_ is not None and rule.unit_sizes_ is not None:
            arrays |= {f"calibration.{path}_groups": rule.units_, f"calibration.{path}_sizes": rule.unit_sizes_}
    if rules.overall.joint == "max":
        arrays["calibration.shift"], arrays["calibration.scale"] = rules.overall.scales()
    return arrays


def _novelty_arrays(model: PoseModel) -> dict[str, AnyArray]:
    novelty, rules = model.novelty, model.rules
    if novelty is None:
        return {}
    arrays = {"novelty.references": novelty.test.references, "novelty.groups": novelty.test.units_}
    if novelty.matched is not None:
        arrays |= {"novelty.matched": novelty.matched.scores_, "novelty.matched_groups": novelty.matched.units_}
    disturbed = novelty.disturbed
    if disturbed and rules.disturbed is not None and rules.disturbed_p is not None and model.quality is not None:
        arrays |= {"novelty.disturbed": disturbed.scores_, "novelty.disturbed_groups": disturbed.units_}
        arrays["calibration.disturbed"] = rules.disturbed.scores_
        arrays["calibration.disturbed_p"] = rules.disturbed_p
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
        record, content, network = _read(folder)
        return _assemble(record, load_tensors(content), network, folder)
    except (ModelFileError, MissingPackageError):
        raise
    except _DAMAGE as exc:
        raise ModelFileError(f"{folder}: is no complete {_FORMAT}: {type(exc).__name__}: {exc}") from exc


def model_digest(folder: Path) -> str | None:
    """Digest of the trained model in a folder, without its radius; None without a model."""
    try:
        digest = _read_record(folder / _JSON)["weights_sha256"]
    except (ModelFileError, KeyError):
        return None
    return str(digest)


def _network_file(record: dict[str, Any]) -> str:
    return _NETWORKS.replace("*", record["network"]["sha256"][:8])


def _read(folder: Path) -> tuple[dict[str, Any], bytes, bytes | None]:
    """The record and the files that it names; read again if another process is just replacing them."""
    for attempt in range(_ATTEMPTS):
        record = _read_record(folder / _JSON)
        try:
            weights = _named((folder / _NEXT, folder / _WEIGHTS), record["weights_sha256"])
            if record.get("network") is None:
                return record, weights, None
            return record, weights, _named((folder / _network_file(record),), record["network"]["sha256"])
        except ModelFileError:
            if attempt + 1 == _ATTEMPTS:
                raise
    raise AssertionError


def _named(paths: Sequence[Path], sha256: str) -> bytes:
    """The content of the one of these files whose digest is `sha256`."""
    problem = ""
    for path in paths:
        try:
            content = path.read_bytes()
        except OSError as exc:
            problem = f"cannot be read: {exc.strerror}"
            continue
        if hashlib.sha256(content).hexdigest() == sha256:
            return content
        problem = f"is not the file that was saved with {_JSON}: its digest differs"
    raise ModelFileError(f"{paths[-1]}: {problem}")


def _backbone(record: dict[str, Any], network: bytes | None, folder: Path) -> Backbone:
    config = BackboneConfig(**{**record["backbone"], "grid": tuple(record["backbone"]["grid"])})
    if network is not None:
        return OnnxBackbone(config, network)
    with require_extra("train", f"{folder}: a model that runs its network in torch"):
        from conformodal.features.networks.torch_backbone import TorchBackbone  # noqa: PLC0415

    backbone = TorchBackbone(config)
    if backbone.fingerprint != record["backbone_fingerprint"]:
        raise ModelFileError(
            f"{folder / _WEIGHTS}: was trained on features of {config.name} in another version; install the one that "
            "made it, or train again"
        )
    return backbone


def _assemble(record: dict[str, Any], arrays: dict[str, AnyArray], network: bytes | None, folder: Path) -> PoseModel:
    backbone = _backbone(record, network, folder)
    bins = QuantileBins.from_edges(_numbered(arrays, "bins"))
    sources = tuple(_source(its["name"], its["settings"], arrays) for its in record["sources"])
    how, split = record["calibration"], record["split"]
    novelty = _novelty(arrays, backbone.config.grid)
    rules = _rules(QuantileBins.from_edges(_numbered(arrays, "cells")), how, arrays, novelty)
    return PoseModel(
        backbone=backbone,
        localizer=Localizer(sources, bins, arrays["sign_reference"]),
        novelty=novelty,
        rules=rules,
        prior=_prior(record["prior"]),
        camera=PinholeCamera(**record["camera"]),
        split=Split(split["kind"], split["seed"], **{part: arrays[f"split.{part}"] for part in _PARTS}),
        known_frames=FrameIdentities(**{k: arrays[f"known.{k}"] for k in _IDENTITIES}),
        configuration=record["configuration"],
        radius=_radius(record["radius"]),
        comparison=None if record.get("comparison") is None else SourceComparison(**record["comparison"]),
        path_rules={
            path: _path_rule(rules, arrays, name) for path in PATHS if (name := f"calibration.{path}") in arrays
        },
        reliable_p=float(how["reliable_p"]),
        quality=QualityRange(*arrays["quality"]) if "quality" in arrays else None,
    )


def _numbered(arrays: dict[str, AnyArray], name: str) -> list[AnyArray]:
    """The arrays ``NAME.0``, ``NAME.1``, ..."""
    n = sum(key.startswith(f"{name}.") for key in arrays)
    return [arrays[f"{name}.{j}"] for j in range(n)]


def _source(name: str, settings: dict[str, Any], arrays: dict[str, AnyArray]) -> PoseSource:
    start = f"source.{name}."
    its = {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}
    return find_source(name).from_state(SourceState(its, settings))


def _rules(
    cells: QuantileBins, how: dict[str, Any], arrays: dict[str, AnyArray], novelty: PlaceNovelty | None
) -> RegionRules:
    overall = _calibration(cells, how, arrays)
    recognised, known_p = arrays.get("calibration.recognised"), arrays["calibration.known_p"]
    rules = RegionRules(overall, recognised, known_p, float(how["novelty_level"]))
    if novelty is None or novelty.disturbed is None:
        return rules
    groups = None if overall.units_ is None else novelty.disturbed.units_
    disturbed = copy(overall).calibrate_scores(arrays["calibration.disturbed"], groups)
    return replace(rules, disturbed=disturbed, disturbed_p=arrays["calibration.disturbed_p"])


def _calibration(bins: QuantileBins, how: dict[str, Any], arrays: dict[str, AnyArray]) -> SplitConformal:
    calibration = SplitConformal(bins, float(how["alpha"]), how["score"], how["joint"])
    if calibration.joint == "max":
        calibration.set_scale(arrays["calibration.scale"], arrays["calibration.shift"])
    return calibration.calibrate_scores(arrays["calibration.overall"], arrays.get("calibration.groups"))


def _path_rule(rules: RegionRules, arrays: dict[str, AnyArray], name: str) -> SplitConformal:
    rule = path_rule(rules.overall.bins, rules.overall.alpha)
    scores = np.repeat(arrays[name][:, None], rule.bins.n_targets, axis=1)
    return rule.calibrate_scores(scores, *(arrays.get(f"{name}_{its}") for its in ("groups", "sizes")))


def _novelty(arrays: dict[str, AnyArray], grid: tuple[int, int]) -> PlaceNovelty | None:
    if "novelty.references" not in arrays:
        return None
    test = NoveltyTest(arrays["novelty.references"], arrays["novelty.groups"])
    own = {
        kind: test.rescored(arrays[name], arrays[f"{name}_groups"])
        for kind in ("matched", "disturbed")
        if (name := f"novelty.{kind}") in arrays
    }
    return PlaceNovelty(test, grid, **own)


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    """The record with null for infinity and NaN, which JSON does not have."""
    return {k: finite_or_none(v) if isinstance(v, float) else v for k, v in record.items()}


def _prior(record: dict[str, Any]) -> MotionPrior:
    tables = {k: tuple(record[k]) for k in _PRIOR_TABLES}
    depths = {k: math.nan if record[k] is None else float(record[k]) for k in _PRIOR_DEPTHS}
    return MotionPrior(**{**record, **tables, **depths, "volume_m3": float(record["volume_m3"])})


def _radius(record: dict[str, Any] | None) -> PoseRadius | None:
    if record is None:
        return None
    limit = math.inf if record["radius_rad"] is None else float(record["radius_rad"])
    return PoseRadius(**{**record, "radius_rad": limit})


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise ModelFileError(f"{path}: no saved model there: {exc.strerror}") from exc
    except (ValueError, RecursionError) as exc:
        raise ModelFileError(f"{path}: is no JSON: {exc}") from exc
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ModelFileError(f"{path}: holds format {found!r}, expected {_FORMAT!r}")
    stated = record.pop("sha256", None)
    if stated != _digest(record):
        raise ModelFileError(f"{path}: was altered since it was saved: its digest differs")
    return record


def _digest(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
