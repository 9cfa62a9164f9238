"""Saved models: arrays in safetensors, the network in ONNX, everything else in JSON; no pickle and no code.

``model.json`` names the other files with their digests, and has one of itself. They detect damaged or altered files;
they are not a signature, so they do not prove who saved a model.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal.conformal import ConformodalError, NoveltyTest, QuantileBins, SplitConformal
from conformodal.conformal.calibrators.base import Joint
from conformodal.core.arrays import AnyArray
from conformodal.core.extras import MissingPackageError
from conformodal.core.files import kind_of_file, read_file, write_whole
from conformodal.core.ranges import RANGES, Range
from conformodal.core.schema import ArraySpec, ListOf, check_arrays, check_json
from conformodal.core.words import describe_format, finite_or_none
from conformodal.features.backbone import Backbone, BackboneConfig
from conformodal.features.local import DETECTORS, Detector, QualityRange
from conformodal.geometry import TARGET_NAMES, PinholeCamera
from conformodal.geometry.camera import CAMERA_JSON
from conformodal.io import Split, SplitKind
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import MotionPrior
from conformodal.localizer.regions import PlaceNovelty, RegionRules
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.sources.registry import SourceState, find_source

from .config import Method
from .identity import FrameIdentities
from .model import PATHS, ExpectedInput, JournalEntry, PathRule, PoseModel, SourceComparison, path_rule

FORMAT = "conformodal-model-36"
_JSON = "model.json"
_FILES = {  # with the first digits of their digests; the detector of local features may have no network: an empty file
    "weights": "weights-{}.safetensors",
    "network": "network-{}.onnx",
    "detector": "detector-{}.zip",
}
# what reading damaged files raises: ValueError is every error of this package too, RuntimeError JSON without end
_DAMAGE = (SafetensorError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RuntimeError)
_PARTS = ("train", "calibration", "test")
_ARRAYS: dict[str, ArraySpec] = {  # of a model; those of its sources are theirs, see SourceState.check
    "frames.files": ArraySpec("B", ("n_frames", 16), "anything"),
    **{f"bins.{j}": ArraySpec("d", (f"edges of target {j}",), "increasing") for j in range(len(TARGET_NAMES))},
    **{f"split.{part}": ArraySpec("lq", (part,), "increasing", below="n_frames") for part in _PARTS},
    "sign_reference": ArraySpec("d", (4,), "not all zero"),
    "frames.poses": ArraySpec("d", ("n_frames", 7), "finite or NaN"),
    "colours": ArraySpec("d", ("colours",)),
    "calibration.scores": ArraySpec("fd", ("n", 7), "finite or infinite"),
    "calibration.known_p": ArraySpec("d", ("n",), "probabilities or NaN"),
    "calibration.recognised": ArraySpec("?", ("n",), "anything"),
    "calibration.units": ArraySpec("lq", ("n",), "anything"),
    "calibration.loc": ArraySpec("d", (7,)),
    "calibration.scale": ArraySpec("d", (7,), "positive"),
    "novelty.references": ArraySpec("efd", ("references", "n_coarse")),
    "novelty.units": ArraySpec("lq", ("references",), "anything"),
    "matched.scores": ArraySpec("d", ("matched",), "finite or infinite"),
    "matched.units": ArraySpec("lq", ("matched",), "anything"),
    "disturbed.units": ArraySpec("lq", ("disturbed",), "anything"),
    "disturbed.scores": ArraySpec("fd", ("disturbed", 7), "finite or infinite"),
    "disturbed.known_p": ArraySpec("d", ("disturbed",), "probabilities or NaN"),
    "quality": ArraySpec("d", (2, 3)),
    "rooms.positions_xyz": ArraySpec("d", ("frames of rooms", 3)),
    "rooms.rooms": ArraySpec("lq", ("frames of rooms",), "anything"),
    "calibration.rooms": ArraySpec("lq", ("n",), "anything"),
}
for _path_name in PATHS:
    _rows = (f"frames of path {_path_name}?",)
    _ARRAYS |= {
        f"path.{_path_name}.scores": ArraySpec("fd", _rows, "finite or infinite"),
        f"path.{_path_name}.units": ArraySpec("lq", _rows, "anything"),
        f"path.{_path_name}.sizes": ArraySpec("lq", _rows, "positive"),
        f"path.{_path_name}.longest_gap_s": ArraySpec("d", (1,)),
        f"path.{_path_name}.squared": ArraySpec("d", _rows, "positive"),
        f"path.{_path_name}.known_p": ArraySpec("d", _rows, "probabilities or NaN"),
        f"path.{_path_name}.rooms": ArraySpec("lq", _rows, "anything"),
    }
_RATE, _SHARE, _POSITIVE = Range(0, 1, "()"), Range(0, 1), Range(0, 1e9, "(]")
_COUNT, _SIDE = Range(0, 10**9, whole=True), Range(1, 100_000, whole=True)
_RECORD: dict[str, Any] = {  # the content of model.json, without its digest
    "format": str,
    "backbone": {"name": str, "block": (None, _COUNT), "width": _SIDE, "height": _SIDE, "grid": [_SIDE, _SIDE]},
    "sources": ListOf({"name": str, "settings": dict}),
    "calibration": {"alpha": _RATE, "score": str, "joint": {*get_args(Joint)}, "novelty_level": Range(0, 1, "[)")},
    "prior": {
        "turn_rate_rad_s": _POSITIVE,
        "intervals_s": ListOf(_POSITIVE),
        "top_speed_mps": ListOf(_POSITIVE),
        "acceleration_density": ListOf(_POSITIVE),
        "depth_m": (None, _POSITIVE),
        "depth_spread": (None, Range(0, 1e9)),
        "volume_m3": Range(0, 1e30, "(]"),  # of a world in millimetres, too
    },
    "camera": CAMERA_JSON,
    "split": {"kind": SplitKind, "seed": RANGES["seed"]},
    "step_s": _POSITIVE,
    "configuration": {"method": Method, "data": str, "unit": {"m", "units"}, "features": {*DETECTORS}, ...: object},
    "comparison": (
        None,
        {
            "n_frames": Range(1, 10**9, whole=True),
            "n_both": _COUNT,
            "n_model_only": _COUNT,
            "n_folds_only": _COUNT,
            "larger": _SHARE,
        },
    ),
    "journal": ListOf(
        {
            "name": str,
            "date": str,
            "n_frames": Range(1, 10**9, whole=True),
            **dict.fromkeys(("bounded", "reliable"), _SHARE),
            **dict.fromkeys(("coverage", "path_coverage", "path_bounded"), (None, _SHARE)),
            "median_m": (None, Range(0, 1e9)),
            **dict.fromkeys(("first_unit", "n_units"), _COUNT),
        },
        least=0,
    ),
    "weights": str,
    "network": str,
    "detector": str,
}


class ModelFileError(ConformodalError):
    """A saved model that is missing, incomplete, of another version, or not as it was saved; names the file."""


def save_model(model: PoseModel, folder: Path) -> None:
    """Write a model into a folder, created if missing; an earlier model stays complete until the new one is."""
    states = {source.name: source.state() for source in model.localizer.sources}
    arrays = {f"source.{name}.{k}": v for name, state in states.items() for k, v in state.arrays.items()}
    arrays |= {k: v for k, v in _arrays(model).items() if v is not None}
    weights = save_tensors({k: np.ascontiguousarray(v) for k, v in arrays.items()})
    contents = {"weights": weights, "network": model.backbone.content, "detector": model.detector.content}
    record: dict[str, Any] = {
        "format": FORMAT,
        "backbone": asdict(model.backbone.config),
        "sources": [{"name": name, "settings": state.settings} for name, state in states.items()],
        "calibration": {
            "alpha": model.alpha,
            "score": model.calibration.score_.name,
            "joint": model.calibration.joint,
            "novelty_level": model.rules.level,
        },
        "prior": {k: finite_or_none(v) if isinstance(v, float) else v for k, v in asdict(model.prior).items()},
        "camera": asdict(model.camera),
        "split": {"kind": str(model.split.kind), "seed": model.split.seed},
        "step_s": model.expected_input.step_s,
        "configuration": model.configuration,
        "comparison": None if model.comparison is None else asdict(model.comparison),
        "journal": [asdict(entry) for entry in model.journal],
        **{name: hashlib.sha256(contents[name]).hexdigest() for name in _FILES},
    }
    try:
        check_json(json.loads(json.dumps(record)), _RECORD, _JSON)
        check_arrays(_without_sources(arrays), _ARRAYS, _sizes_of(model.backbone))
    except _DAMAGE as exc:
        raise ModelFileError(f"{folder}: the model could not be read back, and is not saved: {exc}") from exc
    record["sha256"] = _digest(record)
    for name, content in contents.items():
        write_whole(_path(folder, name, record[name]), content)
    write_whole(folder / _JSON, json.dumps(record, indent=1) + "\n")
    for name, pattern in _FILES.items():  # of an earlier model
        for path in folder.glob(pattern.format("*")):
            if path != _path(folder, name, record[name]):
                path.unlink(missing_ok=True)


def _sizes_of(backbone: Backbone) -> dict[str, int]:
    """Sizes that arrays of a model share with its network."""
    rows, columns = backbone.config.grid
    return {"n_features": backbone.n_features, "n_coarse": backbone.n_coarse, "n_rows": rows, "n_columns": columns}


def _without_sources(arrays: dict[str, AnyArray]) -> dict[str, AnyArray]:
    """The arrays of a model but those of its sources, which check their own."""
    return {name: array for name, array in arrays.items() if not name.startswith("source.")}


def _path(folder: Path, name: str, digest: str) -> Path:
    return folder / _FILES[name].format(digest[:8])


def _digest(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _arrays(model: PoseModel) -> dict[str, AnyArray | None]:
    """All arrays of a model but those of its sources; None for what it does not have."""
    rules, overall, novelty = model.rules, model.calibration, model.novelty
    loc, scale = overall.scales() if overall.joint == "max" else (None, None)
    arrays: dict[str, AnyArray | None] = {
        **{f"bins.{j}": edges for j, edges in enumerate(model.bins.edges_)},
        **{f"split.{part}": model.split.part(part) for part in _PARTS},
        "sign_reference": model.sign_reference,
        "frames.files": model.known_frames.files,
        "frames.poses": model.known_frames.poses,
        "colours": model.expected_input.colours,
        "calibration.scores": overall.scores_,
        "calibration.known_p": rules.known_p,
        "calibration.recognised": rules.recognised,
        "calibration.rooms": rules.rooms,
        "calibration.units": overall.units_,
        "calibration.loc": loc,
        "calibration.scale": scale,
    }
    for path, rule in model.path_rules.items():
        calibration = rule.calibration
        arrays[f"path.{path}.scores"] = calibration.scores_.max(axis=1)
        arrays |= {f"path.{path}.units": calibration.units_, f"path.{path}.sizes": calibration.unit_sizes_}
        arrays |= {f"path.{path}.longest_gap_s": np.array([rule.longest_gap_s]), f"path.{path}.rooms": rule.rooms}
        arrays |= {f"path.{path}.squared": rule.squared, f"path.{path}.known_p": rule.known_p}
    if model.rooms is not None:
        arrays |= {"rooms.positions_xyz": model.rooms.positions_xyz, "rooms.rooms": model.rooms.rooms}
    if novelty is not None:
        arrays |= {"novelty.references": novelty.test.references, "novelty.units": novelty.test.units_}
        if novelty.matched is not None:
            arrays |= {"matched.scores": novelty.matched.scores_, "matched.units": novelty.matched.units_}
    if rules.disturbed is not None and model.quality is not None:
        arrays |= {"disturbed.scores": rules.disturbed.scores_, "disturbed.known_p": rules.disturbed_p}
        arrays |= {"disturbed.units": rules.disturbed.units_}
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
        check_json(record, _RECORD, _JSON)
        return _assemble(record, load_tensors(_read(folder, "weights", record)), folder)
    except (ModelFileError, MissingPackageError):
        raise
    except _DAMAGE as exc:
        raise ModelFileError(f"{folder}: is not a complete {FORMAT}: {type(exc).__name__}: {exc}") from exc


def model_digest(folder: Path) -> str | None:
    """Digest of the trained model in a folder; None without a model."""
    try:
        return str(_read_record(folder / _JSON)["weights"])
    except (ModelFileError, KeyError):
        return None


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(read_file(path))
    except OSError as exc:
        kind = kind_of_file(path.parent)
        what = f"{path.parent}: {kind}" if kind else f"{path}: no saved model there: {exc.strerror}"
        raise ModelFileError(what) from exc
    except (ValueError, RecursionError) as exc:
        raise ModelFileError(f"{path}: is not JSON: {exc}") from exc
    stated = record.get("format") if isinstance(record, dict) else type(record).__name__
    if stated != FORMAT:
        raise ModelFileError(f"{path}: {describe_format(stated, FORMAT, 'Train the model again')}")
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


def _assemble(record: dict[str, Any], arrays: dict[str, AnyArray], folder: Path) -> PoseModel:
    stated, split, comparison = (record[name] for name in ("calibration", "split", "comparison"))
    config = BackboneConfig(**record["backbone"] | {"grid": tuple(record["backbone"]["grid"])})
    with _naming("backbone"):
        backbone = Backbone(config, _read(folder, "network", record))
    with _naming("detector"):
        detector: Detector = DETECTORS[record["configuration"]["features"]](_read(folder, "detector", record))
    sizes = _sizes_of(backbone)
    check_arrays(_without_sources(arrays), _ARRAYS, sizes)
    bins = QuantileBins.from_edges([arrays[f"bins.{j}"] for j in range(len(TARGET_NAMES))])
    sizes["n_bins"] = sum(bins.sizes)
    sources = []
    for number, source in enumerate(record["sources"]):
        start = f"source.{source['name']}."
        mine = {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}
        with _naming(f"sources.{number}"):
            state = SourceState(mine, source["settings"], sizes, bins.sizes)
            sources.append(find_source(source["name"]).from_state(state))
    prior = _prior(record["prior"])
    localizer = Localizer(tuple(sources), bins, arrays["sign_reference"], prior.depth_m)
    paper = record["configuration"]["method"] == Method.PAPER
    with _naming("novelty"):
        novelty = _novelty(arrays, config.grid)
    with _naming("calibration"):
        rules = _rules(bins if paper else localizer.cells, stated, arrays)
    with _naming("path"):
        path_rules = {path: _path_rule(rules, arrays, path) for path in PATHS if f"path.{path}.scores" in arrays}
    return PoseModel(
        backbone=backbone,
        localizer=localizer,
        novelty=novelty,
        rules=rules,
        prior=prior,
        camera=PinholeCamera(**record["camera"]),
        split=Split(split["kind"], split["seed"], **{part: arrays[f"split.{part}"] for part in _PARTS}),
        detector=detector,
        known_frames=FrameIdentities(arrays["frames.files"], arrays["frames.poses"]),
        expected_input=ExpectedInput(float(record["step_s"]), arrays["colours"]),
        configuration=record["configuration"],
        comparison=None if comparison is None else SourceComparison(**comparison),
        path_rules=path_rules,
        quality=QualityRange(*arrays["quality"]) if "quality" in arrays else None,
        rooms=_rooms(arrays),
        journal=tuple(JournalEntry(**entry) for entry in record["journal"]),
    )


@contextmanager
def _naming(part: str) -> Iterator[None]:
    """Name the part of a model that cannot be restored."""
    try:
        yield
    except ModelFileError:
        raise
    except ConformodalError as exc:
        if isinstance(exc, MissingPackageError):
            raise
        raise ConformodalError(f"{part}: {exc}") from exc


def _rooms(arrays: dict[str, AnyArray]) -> Rooms | None:
    if "rooms.rooms" not in arrays:
        return None
    return Rooms(arrays["rooms.positions_xyz"], arrays["rooms.rooms"])


def _prior(record: dict[str, Any]) -> MotionPrior:
    table = [record[name] for name in ("intervals_s", "top_speed_mps", "acceleration_density")]
    if len({len(column) for column in table}) > 1 or (np.diff(table[0]) <= 0).any():
        raise ConformodalError(f"prior.intervals_s must increase, with as many speeds and densities, got {table}")
    prior: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record.items()}
    return MotionPrior(**prior | {k: math.nan for k in ("depth_m", "depth_spread") if prior[k] is None})


def _rules(cells: QuantileBins, stated: dict[str, Any], arrays: dict[str, AnyArray]) -> RegionRules:
    overall = SplitConformal(cells, float(stated["alpha"]), stated["score"], stated["joint"])
    if overall.joint == "max":
        overall.set_scale(arrays["calibration.scale"], arrays["calibration.loc"])
    overall.calibrate_scores(arrays["calibration.scores"], arrays.get("calibration.units"))
    known_p, recognised = arrays["calibration.known_p"], arrays.get("calibration.recognised")
    level, rooms = float(stated["novelty_level"]), arrays.get("calibration.rooms")
    rules = RegionRules(overall, recognised, known_p, level, rooms=rooms)
    if "disturbed.scores" not in arrays:
        return rules
    units = None if overall.units_ is None else arrays["disturbed.units"]
    disturbed = copy(overall).calibrate_scores(arrays["disturbed.scores"], units)
    return replace(rules, disturbed=disturbed, disturbed_p=arrays["disturbed.known_p"])


def _path_rule(rules: RegionRules, arrays: dict[str, AnyArray], path: str) -> PathRule:
    rule = path_rule(rules.overall.bins, rules.overall.alpha)
    scores = np.repeat(arrays[f"path.{path}.scores"][:, None], rule.bins.n_targets, axis=1)
    of_units = () if rules.overall.units_ is None else ("units", "sizes")
    rule.calibrate_scores(scores, *(arrays[f"path.{path}.{name}"] for name in of_units))
    squared, known_p, rooms = (arrays[f"path.{path}.{name}"] for name in ("squared", "known_p", "rooms"))
    longest_gap_s = float(arrays[f"path.{path}.longest_gap_s"][0])
    return PathRule(rule, longest_gap_s, squared, known_p, rules.level, rooms)


def _novelty(arrays: dict[str, AnyArray], grid: tuple[int, int]) -> PlaceNovelty | None:
    if "novelty.references" not in arrays:
        return None
    test = NoveltyTest(arrays["novelty.references"], arrays["novelty.units"])
    if "matched.scores" not in arrays:
        return PlaceNovelty(test, grid)
    return PlaceNovelty(test, grid, test.rescored(arrays["matched.scores"], arrays["matched.units"]))
