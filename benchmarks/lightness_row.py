"""One way from pixels to an answer in a process of its own, for benchmarks/lightness.py; no torch is imported."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from scipy.special import erf, softmax
from stream_row import peak_mb

from conformodal.features.head import SoftmaxHead
from conformodal.features.onnx_backbone import OnnxBackbone
from conformodal.io import THUMBNAIL, read_image, thumbnail
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import PoseFilter
from conformodal.localizer.sources.head import HeadSource
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.store import load_model

WARM, PASSES, MEMBERS = 10, 30, 5
Image = np.ndarray
Answer = Callable[[Image], Any]


def head_of(model: PoseModel) -> SoftmaxHead:
    source = model.localizer.find(HeadSource)
    assert source is not None
    return source.head


def means(model: PoseModel, proba: list[np.ndarray]) -> np.ndarray:
    """The mean of each softmax: a pose for each of the rows."""
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in model.bins.edges_]
    return np.stack([p @ m for p, m in zip(proba, middles, strict=True)], axis=1)


def bare(model: PoseModel) -> Answer:
    """The network and its head."""
    head = head_of(model)
    return lambda image: means(model, head.predict_proba(model.backbone.features_of(image)))


def regions(model: PoseModel) -> Answer:
    """The network, its head, and the calibrated region."""
    return lambda image: model.localize(FrameEvidence(model.backbone.features_of(image))).regions


def search(model: PoseModel) -> Answer:
    """The same and the filter over hypotheses; the camera's motion is not measured."""
    pose_filter, frame = PoseFilter(model.prior), iter(range(10**9))

    def answer(image: Image) -> Any:
        found = model.localize(FrameEvidence(model.backbone.features_of(image)))
        return found.regions, pose_filter.push(found.candidates[0], None, next(frame) / 30)

    return answer


def whole(model: PoseModel) -> Answer:
    """All that a stream does with a frame, relative motion among it."""
    odometry, frame = VisualOdometry(model), iter(range(10**9))
    return lambda image: odometry.step(image, next(frame) / 30)


def dropped(model: PoseModel, features: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mean and spread of the head's answers under dropout: one row of `features` per pass, or one for all passes."""
    head = head_of(model)
    training, ours = model.configuration["training"], head.weights
    hidden_share = training["dropout"]
    input_share = hidden_share if training["input_dropout"] is None else training["input_dropout"]

    def drop(x: np.ndarray, share: float) -> np.ndarray:
        mask = rng.random((PASSES, x.shape[1]), dtype=np.float32) >= share
        return x * mask * np.float32(1 / (1 - share))

    x = drop(head.projection.apply(features), input_share) @ ours["trunk.1.weight"].T + ours["trunk.1.bias"]
    x = x - x.mean(axis=1, keepdims=True)
    x /= np.sqrt((x**2).mean(axis=1, keepdims=True) + np.float32(1e-5))
    x = x * ours["trunk.2.weight"] + ours["trunk.2.bias"]
    x = x * np.float32(0.5) * (1 + erf(x * np.float32(np.sqrt(0.5))))
    raw = drop(x, hidden_share) @ ours["output.weight"].T + ours["output.bias"]
    poses = means(model, [softmax(part, axis=1) for part in np.split(raw, np.cumsum(head.outputs)[:-1], axis=1)])
    return np.stack([poses.mean(axis=0), poses.std(axis=0)])


def head_dropout(model: PoseModel) -> Answer:
    """MC dropout in the head alone: the network once, the head for all passes at once."""
    rng = np.random.default_rng(0)
    return lambda image: dropped(model, model.backbone.features_of(image), rng)


def session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])


def network_dropout(model: PoseModel, folder: Path, *, shared: bool) -> Answer:
    """MC dropout in network and head: what precedes the first dropout once, or in every pass, the rest in every one."""
    front, rest, rng = session(folder / "front.onnx"), session(folder / "rest.onnx"), np.random.default_rng(0)

    def answer(image: Image) -> Any:
        pixels = model.backbone.prepare(image)
        start, maps = None, []
        for _ in range(PASSES):
            if start is None or not shared:
                start = front.run(None, {"images": pixels[None]})[0]
            maps.append(rest.run(None, {"start": start})[0])
        picture = np.tile(thumbnail(pixels) * np.sqrt(THUMBNAIL[0] * THUMBNAIL[1]), (PASSES, 1))
        return dropped(model, np.hstack((np.vstack(maps), picture)).astype(np.float32), rng)

    return answer


def ensemble_of_heads(model: PoseModel) -> Answer:
    """Five heads on one network."""
    heads = [copied(head_of(model)) for _ in range(MEMBERS)]

    def answer(image: Image) -> Any:
        features = model.backbone.features_of(image)
        poses = np.concatenate([means(model, head.predict_proba(features)) for head in heads])
        return poses.mean(axis=0), poses.std(axis=0)

    return answer


def ensemble_of_networks(model: PoseModel) -> Answer:
    """Five networks with a head each."""
    assert isinstance(model.backbone, OnnxBackbone)
    config, content = model.backbone.config, model.backbone.content
    members = [(OnnxBackbone(config, bytes(bytearray(content))), copied(head_of(model))) for _ in range(MEMBERS)]

    def answer(image: Image) -> Any:
        poses = np.concatenate([means(model, head.predict_proba(net.features_of(image))) for net, head in members])
        return poses.mean(axis=0), poses.std(axis=0)

    return answer


def copied(head: SoftmaxHead) -> SoftmaxHead:
    """With memory of its own."""
    return replace(head, weights={name: value.copy() for name, value in head.weights.items()})


def way(name: str, model: PoseModel, folder: Path) -> Answer:
    """What answers an image, by name."""
    if name.startswith("network dropout"):
        return network_dropout(model, folder, shared=name.endswith("shared"))
    ways: dict[str, Callable[[PoseModel], Answer]] = {
        "bare": bare,
        "regions": regions,
        "search": search,
        "whole": whole,
        "whole, three sources": whole,
        "head dropout": head_dropout,
        "ensemble of heads": ensemble_of_heads,
        "ensemble of networks": ensemble_of_networks,
    }
    return ways[name](model)


def main() -> None:
    name, folder, paths = json.load(sys.stdin)
    model = load_model(Path(folder) / ("three" if name.endswith("three sources") else "head"))
    answer, spent = way(name, model, Path(folder)), []
    for k, path in enumerate(paths):
        image = read_image(Path(path))
        started = time.process_time()
        answer(image)
        if k >= WARM:
            spent.append(1e3 * (time.process_time() - started))
    print(json.dumps({"ms": spent, "resident_mb": peak_mb()}))


if __name__ == "__main__":
    main()
