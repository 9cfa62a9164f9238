"""Saved models: arrays in safetensors, everything else in JSON. No pickle, and no code, in either.

``model.json`` holds a digest of the weights file and one of itself. They tell a file that was damaged or altered
from the one that was saved; they are no signature, so they do not tell who saved it.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal._files import write_whole
from conformodal.conformal import NoveltyTest, QuantileBins, SplitConformal
from conformodal.datasets import Split, SplitKind
from conformodal.motion import LandmarkMap
from conformodal.poses import PinholeCamera
from conformodal.reasoning import MotionPrior, SpreadScale, fix_cells
from conformodal.vision import Backbone, BackboneConfig, Head, LocalRegression, LocalSettings, Projection

from .errors import ModelFileError
from .fix_scale import FixScale
from .identity import FrameIdentities
from .known import KnownPlaces
from .landmarks import Landmarks
from .local import LocalFinder
from .model import PoseModel
from .radius import PoseRadius, Promise
from .region_rules import RegionRules
from .sizing import Sizing

FORMAT = "conformodal-model-11"
_JSON, _WEIGHTS, _NEXT = "model.json", "weights.safetensors", "weights.safetensors.next"
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
_LOCAL_NUMBERS = ("typical", "limit")
_MAP_ARRAYS = ("T_pose_cam", "poses_se3", "thumbnails", "starts", "points_xyz", "descriptors", "corrections")
_PARTS = ("train", "calibration", "test")
_IDENTITIES = ("files", "pixels", "poses")
_PRIOR_TABLES = ("intervals_s", "top_speed_mps", "acceleration_density")
_PRIOR_DEPTHS = ("depth_m", "depth_spread")


def save_model(model: PoseModel, folder: Path) -> None:
    """Write a model into a folder, created if missing; a model that was there is whole until the new one is."""
    heads = {"head": model.head, **{f"finder{k}": finder for k, finder in enumerate(model.finders)}}
    arrays: dict[str, npt.NDArray[Any]] = {
        f"{name}.{k}": v.numpy() for name, head in heads.items() for k, v in head.state_dict().items()
    }
    if model.backbone.tuned is not None:  # otherwise its package has them
        arrays |= {f"backbone.{k}": v for k, v in model.backbone.weights().items()}
    arrays |= {f"bins.{j}": e for j, e in enumerate(model.bins.edges_)}
    arrays |= {f"split.{part}": model.split.part(part) for part in _PARTS}
    arrays |= {f"known.{k}": getattr(model.known_frames, k) for k in _IDENTITIES}
    arrays["calibration.scores"] = model.calibration.scores_
    arrays |= {"calibration.matched": model.rules.matched, "calibration.known_p": model.rules.known_p}
    if model.calibration.groups_ is not None:
        arrays["calibration.groups"] = model.calibration.groups_
    if model.rules.pooled is not None:
        arrays["calibration.pooled_scores"] = model.rules.pooled.scores_
    if model.known is not None:
        arrays |= {"known.references": model.known.test.references, "known.groups": model.known.test.groups}
    if model.calibration.joint == "max":
        arrays["calibration.shift"], arrays["calibration.scale"] = (
            model.calibration.rule.loc_,
            model.calibration.rule.scale_,
        )
    arrays["sign_reference"] = model.sign_reference
    if model.local is not None:
        own = model.local.regression
        arrays |= {"local.offset": own.projection.offset, "local.components": own.projection.components}
        arrays |= {"local.references": own.references, "local.targets": own.targets}
        arrays["local.target_scale"] = own.target_scale
    shared = model.region_landmarks is model.landmarks  # what is the same map is stored once
    maps = {"landmarks": model.landmarks, "region_landmarks": None if shared else model.region_landmarks}
    for name, known in maps.items():
        if known is not None:
            arrays |= {f"{name}.{k}": getattr(known.map, k) for k in _MAP_ARRAYS}
    weights = save_tensors({k: np.ascontiguousarray(v) for k, v in arrays.items()})
    record: dict[str, Any] = {
        "format": FORMAT,
        "backbone": asdict(model.backbone.config),
        "backbone_fingerprint": model.backbone.fingerprint,
        "head": {"hidden": model.head.output.in_features, "outputs": model.head.outputs, "finders": len(model.finders)},
        "local": _local_record(model.local),
        **{name: _landmarks_record(known) for name, known in maps.items()},
        "calibration": {
            "alpha": str(model.calibration.alpha),
            "score": model.calibration.score.name,
            "joint": model.calibration.joint,
            "novelty_level": model.rules.level,
            "region_landmarks_shared": shared,
        },
        "prior": _finite(asdict(model.prior)),
        "scale": asdict(model.scale),
        "camera": asdict(model.camera),
        "split": {"kind": str(model.split.kind), "seed": model.split.seed},
        "configuration": model.configuration,
        "radius": None if model.radius is None else _finite(asdict(model.radius)),
        "weights_sha256": hashlib.sha256(weights).hexdigest(),
    }
    record["sha256"] = _digest(record)
    # whole at any time: the new weights are beside the old ones until the record of the new ones is there
    write_whole(folder / _NEXT, weights)
    write_whole(folder / _JSON, json.dumps(record, indent=1) + "\n")
    (folder / _NEXT).replace(folder / _WEIGHTS)


def load_model(folder: Path | str) -> PoseModel:
    """Read a model back.

    Raises
    ------
    ModelFileError
        If a file is missing, damaged or altered, or was made for another version or backbone.
    """
    folder = Path(folder)
    try:
        record, content = _read(folder)
        return _assemble(record, load_tensors(content), folder / _WEIGHTS)
    except ModelFileError:
        raise
    except _DAMAGE as exc:
        raise ModelFileError(f"{folder}: is no complete {FORMAT}: {type(exc).__name__}: {exc}") from exc


def model_digest(folder: Path) -> str | None:
    """What identifies the trained model in a folder, whatever radius it was given later; None where there is none."""
    try:
        digest = _read_record(folder / _JSON)["weights_sha256"]
    except (ModelFileError, KeyError):
        return None
    return str(digest)


def _read(folder: Path) -> tuple[dict[str, Any], bytes]:
    """The record, and the weights that it names; read again where another process has just replaced both."""
    path = folder / _WEIGHTS
    for _ in range(_ATTEMPTS):
        record = _read_record(folder / _JSON)
        problem = ""
        for name in (_NEXT, _WEIGHTS):
            try:
                content = (folder / name).read_bytes()
            except OSError as exc:
                problem = f"cannot be read: {exc.strerror}"
                continue
            if hashlib.sha256(content).hexdigest() == record["weights_sha256"]:
                return record, content
            problem = f"is not the file that was saved with {_JSON}: its digest differs"
    raise ModelFileError(f"{path}: {problem}")


def _assemble(record: dict[str, Any], arrays: dict[str, npt.NDArray[Any]], path: Path) -> PoseModel:
    settings = {**record["backbone"], "grid": tuple(record["backbone"]["grid"])}
    backbone = Backbone(BackboneConfig(**settings))
    tuned = {k.removeprefix("backbone."): v for k, v in arrays.items() if k.startswith("backbone.")}
    if tuned:
        backbone.take_weights(tuned)
    if backbone.fingerprint != record["backbone_fingerprint"]:
        raise ModelFileError(
            f"{path}: was trained on features of {backbone.config.name} in another version; install the one that "
            "made it, or train again"
        )
    names = ["head", *(f"finder{k}" for k in range(record["head"]["finders"]))]
    head, *finders = (_head(name, record["head"], arrays) for name in names)
    bins = QuantileBins.from_edges([arrays[f"bins.{j}"] for j in range(len(head.outputs))])
    how = record["calibration"]
    landmarks = _landmarks("landmarks", record, arrays)
    scale = record["scale"]
    kind, seed = SplitKind(record["split"]["kind"]), record["split"]["seed"]
    return PoseModel(
        backbone=backbone,
        head=head,
        finders=tuple(finders),
        local=_local(record["local"], arrays),
        landmarks=landmarks,
        region_landmarks=(
            landmarks if how["region_landmarks_shared"] else _landmarks("region_landmarks", record, arrays)
        ),
        known=_known(arrays),
        bins=bins,
        rules=_rules(bins, how, arrays),
        sign_reference=arrays["sign_reference"],
        prior=_prior(record["prior"]),
        scale=SpreadScale(tuple(scale["position"]), scale["orientation"], scale["growth"]),
        camera=_camera(record["camera"]),
        split=Split(kind, seed, **{part: arrays[f"split.{part}"] for part in _PARTS}),
        known_frames=FrameIdentities(**{k: arrays[f"known.{k}"] for k in _IDENTITIES}),
        configuration=record["configuration"],
        radius=_radius(record["radius"]),
    )


def _rules(bins: QuantileBins, how: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> RegionRules:
    pooled = None
    if "calibration.pooled_scores" in arrays:
        pooled = _calibration(fix_cells(bins), how, arrays, "calibration.pooled_scores")
    softmax = _calibration(bins, how, arrays, "calibration.scores")
    matched, known_p = arrays["calibration.matched"], arrays["calibration.known_p"]
    return RegionRules(softmax, pooled, matched, known_p, float(how["novelty_level"]))


def _calibration(
    bins: QuantileBins, how: dict[str, Any], arrays: dict[str, npt.NDArray[Any]], scores: str
) -> SplitConformal:
    calibration = SplitConformal(bins, how["alpha"], how["score"], how["joint"])
    if calibration.joint == "max":
        calibration.rule.loc_, calibration.rule.scale_ = arrays["calibration.shift"], arrays["calibration.scale"]
    return calibration.calibrate_scores(arrays[scores], arrays.get("calibration.groups"))


def _known(arrays: dict[str, npt.NDArray[Any]]) -> KnownPlaces | None:
    if "known.references" not in arrays:
        return None
    return KnownPlaces(NoveltyTest(arrays["known.references"], arrays["known.groups"]))


def _head(name: str, shape: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> Head:
    start = f"{name}."
    state = {k.removeprefix(start): torch.from_numpy(v) for k, v in arrays.items() if k.startswith(start)}
    head = Head(Projection(state["offset"].numpy(), state["components"].numpy()), shape["outputs"], shape["hidden"])
    head.load_state_dict(state)
    return head.eval()


def _local_record(local: LocalFinder | None) -> dict[str, Any] | None:
    if local is None:
        return None
    numbers = {k: getattr(local, k) for k in _LOCAL_NUMBERS}
    return {"settings": asdict(local.regression.settings), "scale": asdict(local.scale), **numbers}


def _local(record: dict[str, Any] | None, arrays: dict[str, npt.NDArray[Any]]) -> LocalFinder | None:
    if record is None:
        return None
    its = {k.removeprefix("local."): v for k, v in arrays.items() if k.startswith("local.")}
    through = Projection(its["offset"], its["components"])
    settings = LocalSettings(**record["settings"])
    regression = LocalRegression(through, its["references"], its["targets"], its["target_scale"], settings)
    return LocalFinder(regression, scale=_fix_scale(record["scale"]), **{k: record[k] for k in _LOCAL_NUMBERS})


def _landmarks_record(landmarks: Landmarks | None) -> dict[str, Any] | None:
    if landmarks is None:
        return None
    own = landmarks.map
    return {"camera": asdict(own.camera), "depth_m": own.depth_m, "scale": asdict(landmarks.scale)}


def _landmarks(name: str, record: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> Landmarks | None:
    if record[name] is None:
        return None
    its = {k: arrays[f"{name}.{k}"] for k in _MAP_ARRAYS}
    own = LandmarkMap(camera=_camera(record[name]["camera"]), depth_m=record[name]["depth_m"], **its)
    return Landmarks(own, _fix_scale(record[name]["scale"]))


def _fix_scale(record: dict[str, Any]) -> FixScale:
    return FixScale(**{**record, "trust_slopes": tuple(record["trust_slopes"])})


def _camera(record: dict[str, Any]) -> PinholeCamera:
    return PinholeCamera(**{**record, "distortion": tuple(record["distortion"])})


def _finite(record: dict[str, Any]) -> dict[str, Any]:
    """JSON has no infinity and no NaN: null stands for them."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}


def _prior(record: dict[str, Any]) -> MotionPrior:
    tables = {k: tuple(record[k]) for k in _PRIOR_TABLES}
    depths = {k: math.nan if record[k] is None else float(record[k]) for k in _PRIOR_DEPTHS}
    return MotionPrior(**{**record, **tables, **depths})


def _radius(record: dict[str, Any] | None) -> PoseRadius | None:
    if record is None:
        return None
    limit = math.inf if record["radius_rad"] is None else float(record["radius_rad"])
    named = {"promise": Promise(record["promise"]), "sizing": Sizing(record["sizing"])}
    return PoseRadius(**{**record, "radius_rad": limit, **named})


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as exc:
        raise ModelFileError(f"{path}: no saved model there: {exc.strerror}") from exc
    except (ValueError, RecursionError) as exc:
        raise ModelFileError(f"{path}: is no JSON: {exc}") from exc
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise ModelFileError(f"{path}: holds format {found!r}, expected {FORMAT!r}")
    stated = record.pop("sha256", None)
    if stated != _digest(record):
        raise ModelFileError(f"{path}: was altered since it was saved: its digest differs")
    return record


def _digest(record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
