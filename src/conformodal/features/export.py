"""A network in ONNX, which runs without torch."""

from __future__ import annotations

import logging
import warnings
from math import sqrt

import numpy as np
import torch
from torch import nn

from conformodal.core.arrays import Float32Array
from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera

from .backbone import INPUT, OUTPUT, Backbone, BackboneConfig
from .extract import FeatureCache
from .local import DETECTORS, XFEAT_STEP, Detector, XFeatDetector
from .networks import Network
from .settings import VisionError
from .xfeat import XFeat

# What the oldest ONNX Runtime that is supported, 1.20, reads: IR 10 and opset 21. The exporter would write the newest.
OPSET, IR_VERSION = 18, 10
XFEAT_PIXELS = 448 * 320  # to which larger images are reduced for XFeat, see docs/decisions/landmarks.md
_TOLERANCE = 1e-3  # of the largest feature: rounding through some sixty layers; a wrong operator errs by far more


def make_backbone(config: BackboneConfig, cache: FeatureCache) -> Backbone:
    """A network exported to ONNX, cached; preprocessing is included and the batch size dynamic."""
    network = Network(config)
    cached = cache.load(network.digest, "networks")
    if cached is not None:
        return Backbone(config, cached.tobytes())
    two = torch.zeros((2, config.height, config.width, 3), dtype=torch.uint8)
    backbone = Backbone(config, _export(config.name, network, two, [INPUT], [OUTPUT], batched=True))
    images = np.random.default_rng(0).integers(0, 256, two.shape, dtype=np.uint8)
    _check_same(config.name, network.maps(images), backbone.maps(images))
    cache.store(network.digest, np.frombuffer(backbone.content, dtype=np.uint8), "networks")
    return backbone


def make_detector(name: str, camera: PinholeCamera, cache: FeatureCache) -> Detector:
    """A detector of local features for images of a camera; its network, if it has one, is exported and cached."""
    if name != "xfeat":
        return DETECTORS[name]()
    scale = min(1.0, sqrt(XFEAT_PIXELS / (camera.width * camera.height)))
    width, height = (max(1, round(scale * side / XFEAT_STEP)) * XFEAT_STEP for side in (camera.width, camera.height))
    network = XFeat(width, height)
    cached = cache.load(network.digest, "networks")
    if cached is not None:
        return XFeatDetector(cached.tobytes())
    image = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
    content = _export(name, network, torch.from_numpy(image), ["image"], ["features", "logits", "reliability"])
    detector = XFeatDetector(content)
    for expected, made in zip(network(torch.from_numpy(image)), detector.maps(image), strict=True):
        _check_same(name, expected.numpy(), made)
    cache.store(network.digest, np.frombuffer(content, dtype=np.uint8), "networks")
    return detector


def _export(
    name: str,
    network: nn.Module,
    example: torch.Tensor,
    inputs: list[str],
    outputs: list[str],
    *,
    batched: bool = False,
) -> bytes:
    with require_extra("train", "the export of a network"):
        import onnxscript  # noqa: F401, PLC0415 - torch asks for it
    logging.disable(logging.WARNING)  # advice on packages that are not needed
    try:
        with warnings.catch_warnings(action="ignore"):
            program = torch.onnx.export(
                network,
                (example,),
                dynamo=True,
                opset_version=OPSET,
                input_names=inputs,
                output_names=outputs,
                dynamic_shapes=({0: torch.export.Dim("n")},) if batched else None,
                verbose=False,
            )
    except Exception as exc:  # whatever torch and onnxscript raise
        raise VisionError(f"{name} cannot be exported to ONNX: {exc}") from exc
    finally:
        logging.disable(logging.NOTSET)
    assert program is not None
    model = program.model_proto
    model.ir_version = IR_VERSION
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # among them lines of source files of the machine that exports
    return bytes(model.SerializeToString())


def _check_same(name: str, expected: Float32Array, made: Float32Array) -> None:
    if expected.shape != made.shape or np.abs(made - expected).max() > _TOLERANCE * np.abs(expected).max():
        raise VisionError(f"{name} answers otherwise when exported to ONNX")
